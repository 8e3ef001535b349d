"""What an environment that is not midway's observes, as the arrays that midway knows."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten

from midway.errors import ConfigurationError
from midway.types import NumPyArray, Options

Array: TypeAlias = NumPyArray
AnySpace: TypeAlias = spaces.Space[Any]

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
STATE_KEYS = ("achieved_state", "desired_state")
IMAGE_SIDE = 84
"""Sides of the images that networks read (pixels)."""


@dataclass(frozen=True)
class Reading:
    """How one entry of the observation becomes an array.

    Attributes:
        shape: Shape of the array.
        dtype: ``float32`` or ``float64`` for numbers, ``uint8`` for images.
        read: The entry as such an array.
    """

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[object], Array] = field(compare=False)

    @property
    def is_image(self) -> bool:
        """Whether the entry is an image."""
        return len(self.shape) == 3

    def box(self, count: int | None = None) -> spaces.Box:
        """Return the space of the array, or of ``count`` of them."""
        shape = self.shape if count is None else (count, *self.shape)
        low, high = (0, 255) if self.is_image else (-np.inf, np.inf)
        return spaces.Box(low, high, shape, np.dtype(self.dtype).type)


def readings(name: str, space: AnySpace) -> dict[str, Reading]:
    """Return how each entry of a goal environment's observation is read.

    Numbers become vectors, also from dictionaries and tuples; images become 84 x 84 x 3 pixels.
    Goals stay float64, so that success is judged on what the environment itself sees.

    Args:
        name: Name of the environment, for messages.
        space: Its observation space.

    Raises:
        ConfigurationError: The space is not that of a goal environment.
    """
    if not isinstance(space, spaces.Dict) or not set(GOAL_KEYS) <= set(space):
        raise ConfigurationError(
            f"{name} is no goal environment: it must observe a dictionary of {', '.join(GOAL_KEYS)}"
            f", not {_named(space)}"
        )
    keys = GOAL_KEYS + (STATE_KEYS if set(STATE_KEYS) <= set(space) else ())
    found = {key: _reading(name, key, space[key]) for key in keys}
    if found["achieved_goal"].shape != found["desired_goal"].shape:
        raise ConfigurationError(
            f"{name}: achieved_goal {space['achieved_goal'].shape} and desired_goal "
            f"{space['desired_goal'].shape} must have the same shape"
        )
    if found["desired_goal"].is_image and len(keys) == len(GOAL_KEYS):
        raise ConfigurationError(
            f"{name}: its goals are images, which do not tell how far apart they are: observe "
            "achieved_state and desired_state too"
        )
    return found


def _named(space: AnySpace) -> str:
    if isinstance(space, spaces.Dict):
        return "one of " + ", ".join(space)
    return type(space).__name__


def _reading(name: str, key: str, space: AnySpace) -> Reading:
    if isinstance(space, spaces.Box) and _shows_image(space):
        return Reading((IMAGE_SIDE, IMAGE_SIDE, 3), "uint8", _image_reader(name, key, space))
    dtype = "float32" if key == "observation" else "float64"
    if isinstance(space, spaces.Box):
        size = int(np.prod(space.shape))
        return Reading((size,), dtype, lambda value: np.asarray(value, dtype).reshape(size))
    if key != "observation":
        raise ConfigurationError(f"{name}: {key} must be numbers (a Box), not {_named(space)}")
    try:
        size = flatdim(space)
    except (NotImplementedError, ValueError) as error:
        raise ConfigurationError(
            f"{name}: {key} of {type(space).__name__} has no fixed number of entries"
        ) from error
    return Reading((size,), dtype, lambda value: np.asarray(flatten(space, value), dtype))


def _shows_image(box: spaces.Box) -> bool:
    """Return whether a box of bytes has the shape of an image: none of its sides is a few."""
    sides = sorted(box.shape, reverse=True)
    return box.dtype == np.uint8 and len(sides) in (2, 3) and sides[1] >= 16


def _image_reader(name: str, key: str, box: spaces.Box) -> Callable[[object], Array]:
    """Return what makes images of any size and order of axes 84 x 84 x 3."""
    shape = box.shape if len(box.shape) == 3 else (*box.shape, 1)
    channels_first = shape[0] in (1, 3) and shape[2] not in (1, 3)
    if channels_first:
        shape = (*shape[1:], shape[0])
    if shape[2] not in (1, 3):
        raise ConfigurationError(
            f"{name}: {key} has images of {shape[2]} channels: must be 1 or 3 (stacked frames are "
            "not read)"
        )
    rows, columns = (_shrinking(side, IMAGE_SIDE) for side in shape[:2])

    def read(value: object) -> Array:
        image = np.asarray(value, np.uint8)
        if image.ndim == 2:
            image = image[..., None]
        if channels_first:
            image = np.moveaxis(image, 0, 2)
        if image.shape[:2] != (IMAGE_SIDE, IMAGE_SIDE):
            resized = np.einsum("rh,hwc,vw->rvc", rows, image, columns, optimize=True)
            image = np.clip(np.rint(resized), 0, 255).astype(np.uint8)
        return np.ascontiguousarray(np.broadcast_to(image, (IMAGE_SIDE, IMAGE_SIDE, 3)))

    return read


def _shrinking(old: int, new: int) -> Array:
    """Return the matrix ``(new, old)`` of means over the pixels that each new pixel covers."""
    edges = np.linspace(0, old, new + 1)
    low, high = edges[:-1, None], edges[1:, None]
    pixels = np.arange(old)
    covered = np.clip(np.minimum(high, pixels + 1) - np.maximum(low, pixels), 0, None)
    return np.asarray(covered / covered.sum(1, keepdims=True), np.float32)


def word_of(info: Options) -> tuple[str, int]:
    """Return what info says of success: its key, and 1, 0, or -1 where it says nothing."""
    for key in ("is_success", "success"):
        if key in info:
            return key, int(bool(np.asarray(info[key]).all()))
    return "", -1
