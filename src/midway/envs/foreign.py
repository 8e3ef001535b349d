"""Any Gymnasium environment that follows the goal API, by its own id.

Such an environment has the observation keys ``observation``, ``achieved_goal`` and ``desired_goal``
and a method ``compute_reward(achieved_goal, desired_goal, info)``. Training rewards it as the paper
does: -1 on every step, terminated where its own reward says that the goal is reached.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Int, Shaped

from midway.envs.vector import Array, GoalVectorEnv, Observations
from midway.errors import ConfigurationError
from midway.types import ArrayLike, EnvSpec

DEFAULT_EPISODE_STEPS = 1000
"""Steps of an episode where the environment was registered without a limit."""


@dataclass(frozen=True)
class RewardTask:
    """Success as the environment's own sparse reward has it: where that is not negative.

    Attributes:
        gym_id: Id of the environment.
    """

    gym_id: str

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return the Euclidean distance between the goals ``(B,)``, in their own unit."""
        return (((achieved - desired) ** 2).sum(-1)) ** 0.5

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Return reward ``(B,)``, always -1, and terminated ``(B,)``.

        Inside a compiled step the environment is asked on the host.
        """
        if isinstance(achieved, np.ndarray):
            reached = self._reached(achieved, desired)
            return np.full(reached.shape, -1, np.float32), reached
        import jax
        import jax.numpy as jnp

        shape = jax.ShapeDtypeStruct(achieved.shape[:-1], jnp.bool_)  # type: ignore[no-untyped-call]
        reached = jax.pure_callback(self._reached, shape, achieved, desired)
        return jnp.full(achieved.shape[:-1], -1.0, jnp.float32), reached

    def _reached(self, achieved: ArrayLike, desired: ArrayLike) -> Array:
        env: Any = _judge(self.gym_id)
        pairs = zip(np.asarray(achieved), np.asarray(desired), strict=True)
        return np.array([float(env.compute_reward(*pair, {})) >= 0 for pair in pairs], np.bool_)


@cache
def _judge(gym_id: str) -> Any:
    """Return one copy of the environment that only judges goals."""
    return gymnasium.make(gym_id).unwrapped


class ForeignVectorEnv(GoalVectorEnv):
    """Copies of a Gymnasium goal environment, stepped one after the other.

    Its simulator cannot be saved: after `midway resume` all copies begin new episodes. Actions in
    [-1, 1] are scaled to the environment's bounds.

    Args:
        gym_id: Id of the environment.
        num_envs: Number of copies.
        task: ``uniform``: the environment's own distribution of starts and goals.
        num_threads: Not used.

    Raises:
        ConfigurationError: The environment does not follow the goal API, or cannot be made.
    """

    resumable = False

    def __init__(
        self, gym_id: str, num_envs: int = 1, task: str = "uniform", num_threads: int = 0
    ) -> None:
        copies: list[Any] = [_make(gym_id) for _ in range(num_envs)]
        space = _checked_space(gym_id, copies[0])
        self._actions = copies[0].action_space
        limit = getattr(copies[0].spec, "max_episode_steps", None) or DEFAULT_EPISODE_STEPS
        spec = EnvSpec(
            name=gym_id,
            observation_shape=space["observation"].shape or (),
            observation_dtype="float32",
            goal_shape=space["achieved_goal"].shape or (),
            action_dim=int(np.prod(self._actions.shape)),
            max_episode_steps=limit,
            goal_is_observation=False,
            state_shape=None,
            task=RewardTask(gym_id),
        )
        boxes = [_as_float32(space[name]) for name in ("observation", "achieved_goal")]
        super().__init__(spec, num_envs, ("uniform",), task, *boxes)
        self._copies = copies
        self._newest: list[Mapping[str, Any]] = [{}] * num_envs

    def _begin(self, copies: Int[Array, " n"], options: Mapping[str, Any]) -> None:
        for copy in copies:
            seed = int(self.generators[copy].integers(2**31))
            self._newest[copy] = self._copies[copy].reset(seed=seed)[0]

    def _advance(self, actions: Shaped[Array, "num_envs action_dim"]) -> None:
        low, high = self._actions.low, self._actions.high
        for copy, action in enumerate(np.clip(actions, -1, 1)):
            scaled = low + (action.reshape(low.shape) + 1) / 2 * (high - low)
            self._newest[copy] = self._copies[copy].step(scaled.astype(self._actions.dtype))[0]

    def _observe(self) -> Observations:
        names = ("observation", "achieved_goal", "desired_goal")
        shapes = {name: self.single_observation_space[name].shape for name in names}
        nothing = {name: np.zeros(shape or (), np.float32) for name, shape in shapes.items()}
        newest = [{**nothing, **observation} for observation in self._newest]
        return {name: np.stack([o[name] for o in newest]).astype(np.float32) for name in names}

    def close(self, **kwargs: Any) -> None:
        """Close every copy."""
        for copy in self._copies:
            copy.close()


def _make(gym_id: str) -> Any:
    try:
        return gymnasium.make(gym_id, disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(f"environment {gym_id} cannot be made: {reason}") from error


def _checked_space(gym_id: str, env: Any) -> Any:
    """Return the observation space of a goal environment with continuous actions.

    Raises:
        ConfigurationError: It is none.
    """
    space = env.observation_space
    keys = {"observation", "achieved_goal", "desired_goal"}
    if not isinstance(space, spaces.Dict) or not keys <= set(space):
        raise ConfigurationError(f"{gym_id} is no goal environment: it must observe {sorted(keys)}")
    if any(not isinstance(space[key], spaces.Box) or len(space[key].shape) != 1 for key in keys):  # type: ignore[arg-type]
        raise ConfigurationError(f"{gym_id}: observation and goals must be vectors of numbers")
    if not hasattr(env.unwrapped, "compute_reward"):
        raise ConfigurationError(f"{gym_id} is no goal environment: it has no compute_reward")
    actions = env.action_space
    if not isinstance(actions, spaces.Box) or not actions.is_bounded():
        raise ConfigurationError(f"{gym_id}: actions must be numbers within bounds")
    return space


def _as_float32(box: Any) -> spaces.Box:
    return spaces.Box(box.low.astype(np.float32), box.high.astype(np.float32), dtype=np.float32)
