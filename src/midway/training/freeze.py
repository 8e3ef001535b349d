"""Freezing the image encoder: from then on a run is one of an ordinary state agent.

The replay is encoded once, and each new image when it is seen; the agent is created anew for the
features. No update encodes an image any more, and a checkpoint holds none. Networks that learned
while features moved would keep a policy whose spread can sit at its clip, without gradient.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from midway import functional
from midway.agent import AnyAgent, Encoder
from midway.replay.storage import ReplayState
from midway.training.devices import compile_by_lane
from midway.types import EnvSpec, Info, NumPyArray, Observations, Options, Step, VectorGoalEnv

Encode = Callable[[UInt8[NumPyArray, "B H W 3"]], Float[Array, "B F"]]


State = TypeVar("State")


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


def keep(agent: AnyAgent, fresh: State, state: State) -> State:
    """Return the agent created for the features with what it takes over from that of images.

    It gets arrays of its own: an update donates them, and the frozen encoder goes on with the old.
    """
    kept = agent.freezing.kept if agent.freezing else ()
    taken = {name: functional.copy(getattr(state, name)) for name in kept}
    return cast(State, replace(cast(Any, fresh), **taken))


def thawed(env: VectorGoalEnv) -> VectorGoalEnv:
    """Return the environment itself, where it is seen through a frozen encoder."""
    return env.env if isinstance(env, FrozenEnv) else env


class FrozenEnv:
    """A vector environment of images seen through a frozen encoder: features in their place.

    Args:
        env: The environment.
        spec: The specification of the features.
        encode: The encoder, compiled.
    """

    def __init__(self, env: VectorGoalEnv, spec: EnvSpec, encode: Encode) -> None:
        self.env = env
        self._encode = encode
        self.goal_spec = spec
        self.num_envs = env.num_envs
        self.tasks = env.tasks
        self.resumable = env.resumable
        self.logged_info = env.logged_info

    def reset(
        self, *, seed: int | None = None, options: Options | None = None
    ) -> tuple[Observations, Info]:
        """Reset the environment."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self.see(observation), info

    def rest(self, mask: NumPyArray) -> Observations:
        """Ask no more of these environments."""
        return self.see(self.env.rest(mask))

    def step(self, actions: NumPyArray) -> Step:
        """Take a step in every environment."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        return self.see(observation), reward, terminated, truncated, info

    def ways(self) -> NumPyArray:
        """Return how far the goals are."""
        return self.env.ways()

    def state_dict(self) -> dict[str, NumPyArray]:
        """Return all that the future depends on."""
        return self.env.state_dict()

    def load_state_dict(self, state: Mapping[str, NumPyArray]) -> None:
        """Continue from a ``state_dict``."""
        self.env.load_state_dict(state)

    def see(self, observation: Observations) -> Observations:
        """Return the observation with features; what is seen is also what is achieved."""
        pair = np.concatenate([observation["observation"], observation["desired_goal"]])
        seen, goal = np.split(np.asarray(self._encode(pair)), 2)
        return {**observation, "observation": seen, "achieved_goal": seen, "desired_goal": goal}
