"""Trees of arrays as flat dictionaries with readable names, for files."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save

from midway import files
from midway.agent import AgentState
from midway.errors import ConfigurationError
from midway.types import AnyArray, JsonObject, NumPyArray

Tree = TypeVar("Tree", bound=PyTree)

ABOUT = "midway"
"""The one entry of a file's metadata: several would be written in an order of chance."""


def named_arrays(tree: PyTree) -> dict[str, AnyArray]:
    """Return the tree's leaves by their paths, such as ``policy.network.layers.0.weight``."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def with_named_arrays(tree: Tree, arrays: Mapping[str, AnyArray]) -> Tree:
    """Return the tree with its leaves replaced by those of the same name.

    Raises:
        ConfigurationError: A name is missing, or an array has another shape or dtype.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    found = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        array = arrays.get(name)
        if array is None or (array.shape, array.dtype) != (leaf.shape, leaf.dtype):
            kind = "nothing" if array is None else f"{array.dtype}{array.shape}"
            raise ConfigurationError(
                f"stored array {name}: expected {leaf.dtype}{leaf.shape}, found {kind}"
            )
        found.append(jax.numpy.asarray(array))
    tree = jax.tree_util.tree_unflatten(structure, found)
    return tree


def networks_of(state: AgentState, names: tuple[str, ...]) -> dict[str, PyTree]:
    """Return the arrays of some parts of an agent's state, by part."""
    return {name: eqx.filter(getattr(state, name), eqx.is_array) for name in names}


def save_arrays(path: Path, tree: PyTree, about: Mapping[str, object] | None = None) -> None:
    """Write the arrays of a tree as safetensors: a file that is there whole or not at all.

    Args:
        path: The file.
        tree: The arrays.
        about: Plain values that say whose they are; the file's checksum covers them too.

    Raises:
        OSError: It cannot be written.
    """
    arrays = {name: np.asarray(array) for name, array in named_arrays(tree).items()}
    said = files.sealed({**(about or {}), "arrays": _checksums(arrays)})
    files.write(path, save(arrays, metadata={ABOUT: json.dumps(said, sort_keys=True)}))


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays in a file.

    Raises:
        ConfigurationError: The file cannot be read.
    """
    with _opened(path) as file:
        return list(file.keys())


def said_of(path: Path) -> JsonObject:
    """Return what a file says of itself; nothing where it is one of an earlier version.

    Raises:
        ConfigurationError: The file cannot be read, or this part of it was changed.
    """
    with _opened(path) as file:
        metadata = file.metadata()
    if not metadata:
        return {}
    try:
        said = files.parsed(metadata[ABOUT])
        checked = isinstance(said, dict) and files.SEAL in said
    except (KeyError, ValueError):
        checked = False
    if not checked:
        raise ConfigurationError(f"{path} is damaged: it does not say what it holds")
    files.check_seal(said, path)
    found: JsonObject = said
    return found


def load_arrays(path: Path, tree: Tree, about: Mapping[str, object] | None = None) -> Tree:
    """Return the tree with its arrays replaced by those of the same name in a file.

    Args:
        path: The file.
        tree: Arrays of the same shapes.
        about: What the file must say of itself; None for one that may be of an earlier version.

    Raises:
        ConfigurationError: The file cannot be read, was changed, or holds other arrays.
    """
    arrays, said = checked_arrays(path)
    for name, expected in (about or {}).items():
        if said.get(name) != expected:
            raise ConfigurationError(
                f"{path} is of another run: {name} {said.get(name)!r}, expected {expected!r}"
            )
    return with_named_arrays(tree, arrays)


def checked_arrays(path: Path) -> tuple[dict[str, NumPyArray], JsonObject]:
    """Return the arrays of a file by name, and what it says of itself.

    Raises:
        ConfigurationError: The file cannot be read, or was changed.
    """
    said = said_of(path)
    try:
        arrays: dict[str, NumPyArray] = load_file(path)
    except (OSError, SafetensorError, ValueError, TypeError, KeyError) as error:  # absurd shapes
        raise ConfigurationError(f"{path} cannot be read: {error}") from error
    expected = said.get("arrays", {})
    if not isinstance(expected, dict):
        raise ConfigurationError(f"{path} is damaged: it does not say what it holds")
    for name in expected.keys() & arrays.keys():
        if (found := _checksum(arrays[name])) != expected[name]:
            raise ConfigurationError(
                f"{path} is damaged: SHA-256 of {name} {files.short(found)}, "
                f"expected {files.short(expected[name])}"
            )
    return arrays, said


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file of arrays.

    Raises:
        ConfigurationError: The file cannot be read.
    """
    try:
        with safe_open(path, "numpy") as file:
            yield file
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error


def _checksums(arrays: Mapping[str, NumPyArray]) -> dict[str, str]:
    return {name: _checksum(array) for name, array in arrays.items()}


def _checksum(array: NumPyArray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()
