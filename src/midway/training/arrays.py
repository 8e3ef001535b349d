"""Trees of arrays as flat dictionaries with readable names, for files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from midway.types import ConfigurationError

Tree = TypeVar("Tree", bound=PyTree)


def named_arrays(tree: PyTree) -> dict[str, Any]:
    """Return the tree's leaves by their paths, such as ``policy.network.layers.0.weight``."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def with_named_arrays(tree: Tree, arrays: Mapping[str, Any]) -> Tree:
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


def networks_of(state: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the arrays of some parts of an agent's state, by part."""
    return {name: eqx.filter(getattr(state, name), eqx.is_array) for name in names}


def save_arrays(path: Path, tree: PyTree) -> None:
    """Write the arrays of a tree as safetensors: a file that is there whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    arrays = {name: np.asarray(array) for name, array in named_arrays(tree).items()}
    temporary = path.with_name(path.name + ".new")
    try:
        save_file(arrays, temporary)
    except SafetensorError as error:
        raise OSError(f"{path} cannot be written: {error}") from error
    temporary.replace(path)


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays in a file.

    Raises:
        ConfigurationError: The file cannot be read.
    """
    try:
        with safe_open(path, "numpy") as file:
            return list(file.keys())
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error


def load_arrays(path: Path, tree: Tree) -> Tree:
    """Return the tree with its arrays replaced by those of the same name in a file.

    Raises:
        ConfigurationError: The file cannot be read, or holds other arrays.
    """
    try:
        return with_named_arrays(tree, load_file(path))
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error
