"""Settings: a field of a configuration says its default, its source and what is allowed, once.

Presets, ``--set``, preset files and ``config.json`` all go through `changed`.
"""

import ast
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias, TypeVar

from midway.errors import ConfigurationError
from midway.types import Hyperparameters

T = TypeVar("T")
Config = TypeVar("Config", bound=Hyperparameters)

MOST_NUMBERS = 64
"""Entries of a setting that is several numbers, such as the layers of a network."""

Bound: TypeAlias = int | float | None
"""A whole number stays one, so that messages show it as one."""


@dataclasses.dataclass(frozen=True)
class Allowed:
    """What a setting may be: bounds of a number or of each number of a tuple, or choices.

    Attributes:
        source: Where the default comes from, such as ``table 1``.
        meaning: What the setting is, in a few words, with the paper's symbol.
        deviates: Why the default is not the paper's; nothing where it is.
        least: Smallest value.
        above: Bound below, not included.
        most: Largest value.
        below: Bound above, not included.
        choices: All values, where there are only some.
    """

    source: str = ""
    meaning: str = ""
    deviates: str = ""
    least: Bound = None
    above: Bound = None
    most: Bound = None
    below: Bound = None
    choices: tuple[object, ...] = ()

    def complaint(self, value: object) -> str:
        """Return what is wrong with a value of the right type, or nothing."""
        if self.choices:
            listed = ", ".join(map(str, self.choices))
            return "" if value in self.choices else f"choose one of {listed}"
        numbers = value if isinstance(value, tuple) else (value,)
        if len(numbers) > MOST_NUMBERS:
            return f"must be at most {MOST_NUMBERS} numbers"
        for number in numbers:
            if isinstance(number, float) and not math.isfinite(number):
                return "must be finite"
            if isinstance(number, int | float) and not self._inside(number):
                return f"must be {self._range()}"
        return ""

    def _inside(self, number: int | float) -> bool:
        return (
            (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
            and (self.below is None or number < self.below)
        )

    def _range(self) -> str:
        bounds = {
            "at least": self.least,
            "above": self.above,
            "at most": self.most,
            "below": self.below,
        }
        return " and ".join(
            f"{word} {bound}" for word, bound in bounds.items() if bound is not None
        )


def setting(default: T, source: str = "", meaning: str = "", **allowed: Any) -> T:
    """Return a dataclass field with its default, the default's source and what is allowed.

    Args:
        default: The default value.
        source: Where it comes from, such as ``table 1``.
        meaning: What it is, in a few words.
        allowed: Other attributes of `Allowed`.
    """
    rule = Allowed(source=source, meaning=meaning, **allowed)
    field: T = dataclasses.field(default=default, metadata={"allowed": rule})
    return field


def names(config: Hyperparameters) -> tuple[str, ...]:
    """Return the names of a configuration's settings."""
    return tuple(field.name for field in dataclasses.fields(config))


def declared(config: Hyperparameters) -> Iterator[tuple[str, object, Allowed]]:
    """Yield name, value and what is allowed of each setting of a configuration."""
    for field in dataclasses.fields(config):
        yield field.name, getattr(config, field.name), field.metadata.get("allowed", Allowed())


def check(config: Hyperparameters) -> None:
    """Check every setting against what its field allows.

    Raises:
        ConfigurationError: A value has another type than its default, or is not allowed.
    """
    defaults = {field.name: field.default for field in dataclasses.fields(config)}
    for name, value, allowed in declared(config):
        default = defaults[name]
        if default is not dataclasses.MISSING and type(value) is not type(default):
            raise ConfigurationError(f"{name} {value!r}: must be a {type(default).__name__}")
        if complaint := allowed.complaint(value):
            raise ConfigurationError(f"{name} {value}: {complaint}")


def changed(config: Config, changes: Mapping[str, object]) -> Config:
    """Return the configuration with some values replaced, each in the type of the old one.

    Args:
        config: A frozen dataclass of settings.
        changes: Values by name; text is read as a Python literal (or true, false), lists stand for
            tuples.

    Raises:
        ConfigurationError: A name is unknown, or a value has the wrong type or is not allowed.
    """
    [known] = split(changes, [config])
    values = {name: _converted(name, getattr(config, name), new) for name, new in known.items()}
    return dataclasses.replace(config, **values)


def split(
    changes: Mapping[str, object], configs: Sequence[Hyperparameters]
) -> list[dict[str, object]]:
    """Return for each configuration the changes that it has a field for.

    Raises:
        ConfigurationError: None of them has a field of this name.
    """
    known = [names(config) for config in configs]
    for name in changes:
        if not any(name in fields for fields in known):
            listed = ", ".join(field for fields in known for field in fields)
            raise ConfigurationError(f"unknown setting {name!r}: use one of {listed}")
    return [{n: v for n, v in changes.items() if n in fields} for fields in known]


def _converted(name: str, old: object, value: object) -> object:
    """Return the value in the type of the old one."""
    if isinstance(value, str) and not isinstance(old, str):
        value = {"true": "True", "false": "False"}.get(value, value)
        try:
            value = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            raise ConfigurationError(f"{name} {value!r}: not a {type(old).__name__}") from None
    if isinstance(old, Hyperparameters) and not isinstance(value, type(old)):
        return _of_parts(name, old, value)
    if isinstance(old, tuple) and isinstance(value, list):
        value = tuple(value)
    if isinstance(old, float) and type(value) is int:
        value = float(value) if abs(value) < 2**1023 else math.inf
    if isinstance(old, int) and isinstance(value, float) and value.is_integer():
        value = int(value)
    if type(value) is not type(old):
        raise ConfigurationError(f"{name} {value!r}: must be a {type(old).__name__}")
    if isinstance(old, tuple) and isinstance(value, tuple):
        return tuple(_converted(name, _example(old), part) for part in value)
    return value


def _example(old: tuple[object, ...]) -> object:
    return old[0] if old else 1


def _of_parts(name: str, old: Hyperparameters, value: Any) -> Hyperparameters:
    """Return a group of settings, such as the relabelling shares, from its parts."""
    listed = ", ".join(names(old))
    refused = ConfigurationError(f"{name} {value!r}: one value for each of {listed}")
    if not value:  # no part at all would mean the defaults, in silence
        raise refused
    try:
        return type(old)(**value) if isinstance(value, Mapping) else type(old)(*value)
    except TypeError:
        raise refused from None
