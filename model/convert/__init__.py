"""Import of published weights of other projects."""

from model.convert.errors import ConversionError, UnsafePickleError
from model.convert.trajectron import convert_trajectron

__all__ = ["ConversionError", "UnsafePickleError", "convert_trajectron"]
