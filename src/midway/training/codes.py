"""Codes in place of images, once the encoder stays as it is.

The replay is encoded once and each new image when it is seen; from then on no update encodes an
image, and a checkpoint holds none. All other networks begin again: policies that learn from codes
that move can end with their spread at its bound, where no gradient leads back.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from midway.networks.encoder import CODE_SIZE, ImageEncoder
from midway.replay.storage import ReplayState
from midway.training.devices import compile_by_lane
from midway.types import EnvSpec

IMAGES = ("observation", "achieved_goal", "desired_goal")
"""Parts of an observation that are images where the environment's observations are."""

Encode = Callable[[UInt8[Any, "B H W 3"]], Float[Any, "B 16"]]


def encoder_that_stays(state: Any, updates: int) -> ImageEncoder | None:
    """Return the agent's encoder of images if it learns no more, after so many updates."""
    encoder = getattr(state, "encoder", None)
    if isinstance(encoder, ImageEncoder) and 0 < state.config.encoder_updates <= updates:
        return encoder
    return None


def holds_images(replay: ReplayState) -> bool:
    """Return whether a replay's observations are images."""
    return bool(replay.rows["observation"].dtype == jnp.uint8)


def holds_codes(spec: EnvSpec, shape: tuple[int, ...]) -> bool:
    """Return whether a replay's observations, of this shape, are codes instead of images."""
    return spec.is_image and shape[2:] == (CODE_SIZE,)


def begun_again(fresh: Any, state: Any) -> Any:
    """Return the fresh state of the agent with the encoder that the other has learned."""
    return replace(fresh, encoder=state.encoder, encoder_optimizer=state.encoder_optimizer)


class CodedEnv:
    """A vector environment of images seen through an encoder: codes ``(K, 16)`` in their place.

    Args:
        env: The environment.
        encode: The encoder.
    """

    def __init__(self, env: Any, encode: Encode) -> None:
        self._env = env
        self._encode = encode

    def __getattr__(self, name: str) -> Any:
        """Return what is not an observation from the environment."""
        return getattr(self._env, name)

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment."""
        observation, info = self._env.reset(**options)
        return self.see(observation), info

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Take a step in every copy."""
        observation, *outcome = self._env.step(actions)
        return self.see(observation), *outcome

    def see(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with codes; what is seen is also what is achieved."""
        pair = np.concatenate([observation["observation"], observation["desired_goal"]])
        seen, goal = np.split(np.asarray(self._encode(pair)), 2)
        return {**observation, **dict(zip(IMAGES, (seen, seen, goal), strict=True))}


def blank(replay: ReplayState) -> ReplayState:
    """Return the replay with zeros for the codes of its images, to be restored into."""

    def zeros(images: UInt8[Array, "K L H W 3"]) -> Float[Array, "K L 16"]:
        return jnp.zeros((*images.shape[:2], CODE_SIZE))

    return _with_codes(replay, zeros)


def encoded(replay: ReplayState, encoder: ImageEncoder) -> ReplayState:
    """Return the replay with codes for its images."""
    return _with_codes(replay, partial(jax.lax.map, encoder))


def _with_codes(replay: ReplayState, encode: Callable[..., Any]) -> ReplayState:
    images = replay.rows["observation"]
    codes = compile_by_lane(encode, donated=())(images)
    return replay._replace(rows={**replay.rows, "observation": codes})
