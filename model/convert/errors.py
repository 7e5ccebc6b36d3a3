"""What can be wrong with weights that are to be imported."""


class ConversionError(ValueError):
    """The source is not what this package can import; the message says why."""


class UnsafePickleError(ConversionError):
    """A pickle names, calls or encodes something that is not known to be harmless. Nothing of it was run."""
