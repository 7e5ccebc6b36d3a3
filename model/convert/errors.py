"""Errors of the import of weights."""


class ConversionError(ValueError):
    """A source that this package cannot import; the message says why."""


class UnsafePickleError(ConversionError):
    """A pickle that names, calls or encodes anything not known to be harmless. None of it was executed."""
