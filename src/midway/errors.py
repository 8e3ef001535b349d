"""What the package raises on purpose; the file loads nothing, so that declarations import fast."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class ConfigurationError(ValueError):
    """A name, value or folder that the user gave cannot be used; its text is one clear line."""


class NonFiniteError(RuntimeError):
    """A loss or value became NaN or infinite; its text names the quantity."""


class BrokenEnvironmentError(RuntimeError):
    """An environment raised or shows what cannot be used; its text names copy and step.

    Attributes:
        copies: The copies that broke; after a reset, those that have no episode.
        step: What the step gave all the same, whose info ``broken`` tells which copies have no part
            in it; None where it was not taken.
    """

    copies: Sequence[int] = ()
    step: object = None


class NonFiniteObservationError(BrokenEnvironmentError, NonFiniteError):
    """An environment shows a number that is not finite."""


@contextmanager
def needing(extra: str, what: str) -> Iterator[None]:
    """Name the extra that installs a library which the imports inside do not find.

    Args:
        extra: Extra of the package.
        what: What the user asked for.

    Raises:
        ConfigurationError: A library is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "midway").startswith("midway"):
            raise
        raise ConfigurationError(
            f"{what} needs {error.name}: pip install 'midway[{extra}]'"
        ) from error
