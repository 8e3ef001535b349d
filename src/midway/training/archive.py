"""A state as one NumPy archive (``.npz``), written and read array by array.

A replay of images is as large as the rest of the process: nothing here holds a second copy of it.
"""

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import jax
import numpy as np

from midway.errors import ConfigurationError
from midway.types import AnyArray, JsonObject, NumPyArray

Stored: TypeAlias = JsonObject
"""Dictionaries of arrays, within each other."""

HEADER_BYTES = 4096
"""More than NumPy writes before the numbers of an array."""


def write(path: Path, state: Stored) -> None:
    """Write a state; on other devices and in other shards it is the same file.

    Raises:
        OSError: It cannot be written.
    """
    with path.open("wb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in _entries(state).items():
                about = zipfile.ZipInfo(name)
                if array.dtype == np.uint8:  # images: most of them is background
                    about.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(about, "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def read(path: Path, like: Stored) -> Stored:
    """Return a state with the structure of ``like``; arrays of JAX are put where that has them.

    Raises:
        ConfigurationError: The file cannot be read, an array is missing or has another shape or
            dtype.
    """
    with _opened(path) as archive:
        found = [_array(archive, name, leaf) for name, leaf in _entries(like).items()]
    state: Stored = jax.tree.unflatten(jax.tree.structure(like), found)
    return state


def _entries(state: Stored) -> dict[str, AnyArray]:
    """Return the arrays of a state by the names of their files in the archive."""
    leaves, _ = jax.tree.flatten_with_path(state)
    names = (jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves)
    return {f"{name}.npy": leaf for name, (_, leaf) in zip(names, leaves, strict=True)}


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except Exception as error:  # whatever zipfile and NumPy make of a file that somebody wrote
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigurationError(f"{path.name} cannot be read: {reason}") from error


def _array(archive: zipfile.ZipFile, name: str, like: AnyArray) -> AnyArray:
    """Return one array; its size is checked before memory is taken."""
    size = archive.getinfo(name).file_size
    if size > like.nbytes + HEADER_BYTES:
        raise ValueError(f"{name} has {size} bytes, expected {like.nbytes}")
    with archive.open(name) as entry:
        array: NumPyArray = np.lib.format.read_array(entry, allow_pickle=False)
    if array.dtype.kind == "V":  # how NumPy writes what it does not know, such as bfloat16
        array = array.view(like.dtype)
    if (array.shape, array.dtype) != (like.shape, like.dtype):
        raise ValueError(
            f"{name}: expected {like.dtype}{like.shape}, found {array.dtype}{array.shape}"
        )
    if isinstance(like, np.ndarray):
        return array
    placed: jax.Array = jax.device_put(array, like.sharding, may_alias=False)  # for donation
    return placed
