"""Plain values from files, which may hold anything: whether they are what was declared."""

from dataclasses import fields
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints


def check_kinds(values: Any) -> None:
    """Check that every field holds what it is declared to: a file may hold anything.

    Raises:
        TypeError: One does not; the text names it.
    """
    kinds = get_type_hints(type(values))
    for field in fields(values):
        if not _is_of(value := getattr(values, field.name), kinds[field.name]):
            raise TypeError(f"{field.name}: {str(value)[:80]!r}")


def _is_of(value: object, kind: Any) -> bool:
    """Return whether a value is of a declared type, such as ``tuple[int, ...] | None``."""
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if origin in (Union, UnionType):
        return any(_is_of(value, part) for part in parts)
    if origin is tuple:
        return isinstance(value, tuple) and all(_is_of(part, parts[0]) for part in value)
    if kind is float:
        return type(value) in (int, float)
    if kind is str:  # control characters and halves of characters cannot be shown
        return isinstance(value, str) and value.isprintable()
    if kind in (int, bool):
        return type(value) is kind
    return not isinstance(origin, type) or isinstance(value, origin)
