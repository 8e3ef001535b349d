"""Freezing the image encoder: from then on a run is one of an ordinary state agent.

The replay is encoded once, and each new image when it is seen; the agent is created anew for the
features. No update encodes an image any more, and a checkpoint holds none. Networks that learned
while features moved would keep a policy whose spread can sit at its clip, without gradient.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from midway.agent import AnyAgent, Encoder
from midway.replay.storage import ReplayState
from midway.training.devices import compile_by_lane
from midway.types import EnvSpec

Encode = Callable[[UInt8[Any, "B H W 3"]], Float[Any, "B F"]]


def encoded_spec(spec: EnvSpec, encoder: Encoder) -> EnvSpec:
    """Return what an agent of the encoder's features may know of an environment of images."""
    image = jax.ShapeDtypeStruct((1, *spec.observation_shape), jnp.uint8)
    return spec.encoded(eqx.filter_eval_shape(encoder, image).shape[1])


def encoded_replay(replay: ReplayState, encoder: Encoder) -> ReplayState:
    """Return the replay with features for its images."""
    features = compile_by_lane(partial(jax.lax.map, encoder), donated=())(
        replay.rows["observation"]
    )
    return replay._replace(rows={**replay.rows, "observation": features})


def keep(agent: AnyAgent, fresh: Any, state: Any) -> Any:
    """Return the agent created for the features with what it takes over from that of images."""
    kept = agent.freezing.kept if agent.freezing else ()
    return replace(fresh, **{name: getattr(state, name) for name in kept})


class FrozenEnv:
    """A vector environment of images seen through a frozen encoder: features in their place.

    Args:
        env: The environment.
        spec: The specification of the features.
        encode: The encoder, compiled.
    """

    def __init__(self, env: Any, spec: EnvSpec, encode: Encode) -> None:
        self.env = env
        self._encode = encode
        self.goal_spec = spec

    def __getattr__(self, name: str) -> Any:
        """Return what is not an observation from the environment."""
        return getattr(self.env, name)

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment."""
        observation, info = self.env.reset(**options)
        return self.see(observation), info

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Take a step in every environment."""
        observation, *outcome = self.env.step(actions)
        return self.see(observation), *outcome

    def see(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with features; what is seen is also what is achieved."""
        pair = np.concatenate([observation["observation"], observation["desired_goal"]])
        seen, goal = np.split(np.asarray(self._encode(pair)), 2)
        return {**observation, "observation": seen, "achieved_goal": seen, "desired_goal": goal}
