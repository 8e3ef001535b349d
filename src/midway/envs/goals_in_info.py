"""Environments that tell their goal in the info of a reset, as those of OGBench do."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from midway.envs.reading import AnySpace
from midway.errors import ConfigurationError
from midway.types import NamedValues, OwnEnv


class GoalsInInfo(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Observes what the environment does, with the goal that its info told at the last reset.

    Args:
        env: An environment whose ``reset`` returns an observation as the goal, ``info["goal"]``.
        coordinates: The entries of it that make a goal; all of them where there are none.
    """

    def __init__(self, env: OwnEnv, coordinates: tuple[int, ...] = ()) -> None:
        super().__init__(env)
        shown = env.observation_space
        if not isinstance(shown, spaces.Box) or len(shown.shape) != 1:
            raise ConfigurationError(f"its observations are {shown}: goals in info need a vector")
        self._coordinates = np.array(coordinates or range(shown.shape[0]))
        sides = (shown.low.astype(np.float64), shown.high.astype(np.float64))
        bounds = (side[self._coordinates] for side in sides)
        goal = spaces.Box(*bounds, dtype=np.float64)
        entries: dict[str, AnySpace] = {"observation": shown, "achieved_goal": goal}
        entries["desired_goal"] = goal
        self.observation_space = spaces.Dict(entries)
        self._goal = np.zeros(goal.shape)

    def reset(
        self, *, seed: int | None = None, options: NamedValues | None = None
    ) -> tuple[NamedValues, NamedValues]:
        """Begin an episode with a goal of the environment's own."""
        observation, info = self.env.reset(seed=seed, options=options)
        if "goal" not in info:
            raise ConfigurationError("its info has no goal after a reset")
        self._goal = np.asarray(info["goal"], np.float64)[self._coordinates]
        return self._see(observation), info

    def step(self, action: object) -> tuple[NamedValues, float, bool, bool, NamedValues]:
        """Move by one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._see(observation), float(reward), terminated, truncated, info

    def _see(self, observation: object) -> NamedValues:
        achieved = np.asarray(observation, np.float64)[self._coordinates]
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": self._goal}
