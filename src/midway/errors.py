"""What the package raises on purpose; the file loads nothing, so that declarations import fast."""


class ConfigurationError(ValueError):
    """A name, value or folder that the user gave cannot be used; its text is one clear line."""


class NonFiniteError(RuntimeError):
    """A loss or value became NaN or infinite; its text names the quantity."""
