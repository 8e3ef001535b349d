"""Search spaces: what tuning may try of each setting, around the values of a preset."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from midway import settings
from midway.errors import ConfigurationError
from midway.types import Hyperparameters

Scalar: TypeAlias = bool | int | float | str


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds, whole ones where both bounds are.

    Attributes:
        low: Smallest value.
        high: Largest value.
        log: Whether orders of magnitude are drawn alike.
    """

    low: int | float
    high: int | float
    log: bool = False

    def holding(self, value: int | float) -> "Range":
        """Return the range, made wider where the value lies outside."""
        return Range(min(self.low, value), max(self.high, value), self.log)


@dataclass(frozen=True)
class Choice:
    """Some values."""

    values: tuple[Scalar, ...]

    def holding(self, value: Scalar) -> "Choice":
        """Return the choice, with the value among its values."""
        return self if value in self.values else Choice((*self.values, value))


Space: TypeAlias = Mapping[str, Range | Choice]

SPACE: Space = {
    "critic_learning_rate": Range(1e-4, 3e-3, log=True),
    "policy_learning_rate": Range(1e-4, 3e-3, log=True),
    "subgoal_learning_rate": Range(1e-4, 3e-3, log=True),
    "target_update_rate": Range(1e-3, 3e-2, log=True),
    "kl_weight": Range(0.02, 1.0, log=True),
    "advantage_temperature": Range(0.05, 10.0, log=True),
    "n_step": Choice((1, 3, 5)),
    "clip_targets": Choice((False, True)),
    "layer_norm": Choice((False, True)),
}
"""What is tuned by default, of the settings that an agent has.

None changes the number of updates or the networks' size: trials with the same steps take about the
same time.
"""


def of(
    configs: Sequence[Hyperparameters], wanted: Space | None = None
) -> dict[str, Range | Choice]:
    """Return the space of some configurations, each setting's own value included.

    Args:
        configs: The loop's and the agent's settings, as a preset has them.
        wanted: The space; default: `SPACE`, of which settings that are not there are left out.

    Raises:
        ConfigurationError: A wanted setting is not there, or is not a single value.
    """
    values = {name: value for part in configs for name, value, _ in settings.declared(part)}
    if wanted is None:
        wanted = {name: choice for name, choice in SPACE.items() if name in values}
    settings.split(dict.fromkeys(wanted), configs)
    return {name: _holding(name, choice, values[name]) for name, choice in wanted.items()}


def _holding(name: str, choice: Range | Choice, value: object) -> Range | Choice:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(choice, Range) and isinstance(value, int | float) and number:
        return choice.holding(value)
    if isinstance(choice, Choice) and isinstance(value, bool | int | float | str):
        return choice.holding(value)
    raise ConfigurationError(f"space: {name} is {value!r}, which cannot be drawn from {choice}")


def read(path: Path) -> Space:
    """Return the space in a TOML file: ``name = {low = 0.01, high = 1.0, log = true}`` or a list.

    Raises:
        ConfigurationError: The file cannot be read, or holds something else.
    """
    try:
        content = tomllib.loads(path.read_text())
        return {name: _parsed(value) for name, value in content.items()}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, TypeError, ValueError) as error:
        raise ConfigurationError(f"space {path}: {error}") from error


def _parsed(value: object) -> Range | Choice:
    if isinstance(value, list) and len(value) > 1:
        return Choice(tuple(value))
    if not isinstance(value, dict):
        raise ValueError(f"{value!r}: write a list of values, or low, high and log")
    found = Range(**value)
    if not found.low < found.high or (found.log and found.low <= 0):
        raise ValueError(f"{value}: low must be below high, and above 0 where log is true")
    return found
