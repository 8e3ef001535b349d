"""Trees of arrays as flat dictionaries with readable names, for files."""

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
from jaxtyping import PyTree

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
