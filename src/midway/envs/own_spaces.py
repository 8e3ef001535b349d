"""Between the spaces of an environment itself and what agents see of it, without stepping it."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from gymnasium.vector.utils import batch_space, iterate
from jaxtyping import Float

from midway.envs.describing import Foreign
from midway.envs.group import action_bounds, scaled
from midway.envs.reading import GOAL_KEYS, Array, readings
from midway.envs.success import judge
from midway.errors import ConfigurationError
from midway.types import EnvSpec, Options


class Seen(NamedTuple):
    """What agents see of an environment's observation, or of a batch of them.

    Attributes:
        observation: ``(B, ...)``.
        goal: ``(B, ...)``.
        single: Whether it is one observation, and B is 1.
    """

    observation: Array
    goal: Array
    single: bool


def seen(spec: EnvSpec, foreign: Foreign | None, observation: Options) -> Seen:
    """Return what agents see of a dictionary that the environment itself observes.

    Args:
        spec: The environment as agents know it.
        foreign: What was decided about it; None for midway's own.
        observation: ``observation``, ``achieved_goal`` and ``desired_goal``, or batches of each.

    Raises:
        ConfigurationError: An entry is missing, or has another shape than the environment's.
    """
    if missing := [key for key in GOAL_KEYS if key not in observation]:
        raise ConfigurationError(f"observation of {spec.name}: {', '.join(missing)} is missing")
    if foreign is None:
        return _own(spec, observation)
    space = judge(foreign.source).observation_space
    read = readings(spec.name, space)
    shape, goal_shape = np.shape(observation["desired_goal"]), space["desired_goal"].shape
    single = shape == goal_shape
    if not single and shape[1:] != goal_shape:
        raise _refused(spec, "desired_goal", shape, goal_shape)

    def rows(key: str) -> Array:
        shown: Iterable[object] = [observation[key]]
        if not single:
            shown = iterate(batch_space(space[key], shape[0]), observation[key])
        batch = np.stack([read[key].read(row) for row in shown])
        return batch if read[key].is_image else batch.astype(np.float32)

    states, goals = rows("observation"), rows("desired_goal")
    if appends_goal(spec, foreign):
        states = np.concatenate([states, rows("achieved_goal")], axis=1)
    return Seen(states, goals, single)


def in_own_bounds(spec: EnvSpec, foreign: Foreign | None, actions: Float[Array, "B A"]) -> Array:
    """Return actions in [-1, 1] as the environment itself takes them ``(B, ...)``."""
    if foreign is None:
        return actions
    space, (low, high) = judge(foreign.source).action_space, bounds(spec, foreign)
    return scaled(actions, low, high).reshape(-1, *space.shape).astype(space.dtype)


def bounds(spec: EnvSpec, foreign: Foreign | None) -> tuple[Array, Array]:
    """Return the lower and upper bounds of the environment's own actions, flat ``(A,)``."""
    if foreign is None:
        return -np.ones(spec.action_dim), np.ones(spec.action_dim)
    space = judge(foreign.source).action_space
    return action_bounds(space, foreign.settings.action_bound)


def appends_goal(spec: EnvSpec, foreign: Foreign | None) -> bool:
    """Return whether agents see the achieved goal behind an observation that lacks it."""
    if foreign is None:
        return False
    read = readings(spec.name, judge(foreign.source).observation_space)
    return read["observation"].shape != spec.observation_shape


def _own(spec: EnvSpec, observation: Options) -> Seen:
    """Return the observation of an environment of midway's own, which agents see as it is."""
    states = np.asarray(observation["observation"], spec.observation_dtype)
    goals = np.asarray(observation["desired_goal"], spec.observation_dtype)
    single = states.shape == spec.observation_shape
    if single:
        states, goals = states[None], goals[None]
    if states.shape[1:] != spec.observation_shape:
        raise _refused(spec, "observation", states.shape, spec.observation_shape)
    if goals.shape != (len(states), *spec.goal_shape):
        raise _refused(spec, "desired_goal", goals.shape, spec.goal_shape)
    return Seen(states, goals, single)


def _refused(
    spec: EnvSpec, key: str, shape: tuple[int, ...], expected: tuple[int, ...]
) -> ConfigurationError:
    return ConfigurationError(
        f"{key} of {spec.name} has shape {shape}: must be {expected}, or a batch of them"
    )
