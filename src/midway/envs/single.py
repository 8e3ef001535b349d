"""The single environments that Gymnasium makes: batches of one."""

from typing import TypeAlias

import gymnasium
import numpy as np

from midway.envs.reading import AnySpace
from midway.envs.registry import make_vec
from midway.envs.vector import Array
from midway.envs.window import Window, check_display
from midway.errors import ConfigurationError
from midway.types import ArrayLike, Info, Observations, Options

Scalars: TypeAlias = dict[str, float | int]
"""Info of one environment."""

SMALLEST_WINDOW = 480
"""Pixels that the longer side of a picture is enlarged to in a window, in whole multiples."""


class SingleGoalEnv(gymnasium.Env[Observations, Array]):
    """A goal environment of the registry, as a batch of one.

    Observations are dictionaries with ``observation``, ``achieved_goal`` and ``desired_goal``.

    Args:
        name: A name of the registry, such as ``point-u``.
        task: A task of the environment.
        render_mode: ``rgb_array``; ``human``, a window that ``reset`` and ``step`` draw in, until
            it is closed; or None for no pictures.

    Raises:
        ConfigurationError: An unknown name, task or render mode, or no display for a window.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, name: str, task: str = "uniform", render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            modes = ", ".join(self.metadata["render_modes"])
            raise ConfigurationError(f"render_mode {render_mode!r}: must be {modes} or None")
        if render_mode == "human":
            check_display()
        self.render_mode = render_mode
        self._window: Window | None = None
        self.vector = make_vec(name, num_envs=1, task=task, num_threads=1)
        self.goal_spec = self.vector.goal_spec
        self.observation_space: AnySpace = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Options | None = None
    ) -> tuple[Observations, Scalars]:
        """Start a new episode; options are those of the vector environment.

        Raises:
            ConfigurationError: An unknown option or task.
        """
        super().reset(seed=seed)
        # One generator serves both, so that what Gymnasium sees of it is true.
        self.vector.generators[0] = self.np_random
        observations, info = self.vector.reset(options=options)
        if self.render_mode == "human":
            self.render()
        return _first(observations), _first_info(info)

    def step(self, action: Array) -> tuple[Observations, float, bool, bool, Scalars]:
        """Move by one step.

        Args:
            action: ``(action_dim,)``, in [-1, 1].

        Raises:
            ResetNeeded: The episode has ended or never begun.
            ValueError: An action of another shape, or not finite.
        """
        observations, reward, terminated, truncated, info = self.vector.step(
            np.asarray(action)[None]
        )
        if self.render_mode == "human":
            self.render()
        return (
            _first(observations),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            _first_info(info),
        )

    def render(self) -> Array | None:  # type: ignore[override]
        """Return a picture ``(rows, columns, 3)`` uint8; None without ``rgb_array``.

        Raises:
            ConfigurationError: Nothing here can draw.
        """
        pictures = self.vector.render() if self.render_mode else None
        if not pictures:
            return None
        if self.render_mode == "rgb_array":
            return np.asarray(pictures[0])
        self._show(np.asarray(pictures[0]))
        return None

    def close(self) -> None:
        """Close the window, if there is one, and the simulation."""
        if self._window is not None:
            self._window.close()
            self._window = None
        self.vector.close()

    def _show(self, picture: Array) -> None:
        """Show a picture in the window, which the first one opens; once closed, it stays so."""
        times = max(1, round(SMALLEST_WINDOW / max(picture.shape[:2])))
        picture = picture.repeat(times, axis=0).repeat(times, axis=1)
        if self._window is None:
            rate = int(self.metadata["render_fps"])
            self._window = Window(picture.shape, rate, f"midway: {self.goal_spec.name}")
        self._window.show(picture)

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: object) -> ArrayLike:
        """Return the reward of goals ``(goal_dim,)`` or ``(n, goal_dim)``; info is not used.

        Where goals are images, give ``achieved_state`` and ``desired_state`` in their place.

        Raises:
            ConfigurationError: Images, which do not tell how far apart they are.
        """
        return self._outcome(achieved_goal, desired_goal)[0]

    def compute_terminated(
        self, achieved_goal: Array, desired_goal: Array, info: object
    ) -> ArrayLike:
        """Return whether the goal is reached; goals and errors as of ``compute_reward``."""
        return self._outcome(achieved_goal, desired_goal)[1]

    def compute_truncated(self, achieved_goal: Array, desired_goal: Array, info: Scalars) -> bool:
        """Return whether ``info`` is of the last step that an episode may have."""
        return bool(info["elapsed_steps"] >= self.goal_spec.max_episode_steps)

    def _outcome(self, achieved: Array, desired: Array) -> tuple[ArrayLike, ArrayLike]:
        shape = self.goal_spec.state_shape
        if shape is not None and np.shape(achieved)[-1:] + np.shape(desired)[-1:] != shape * 2:
            raise ConfigurationError(
                f"reward of {self.goal_spec.name}: images do not tell distances, "
                "give achieved_state and desired_state"
            )
        return self.goal_spec.task(achieved, desired)


def _first(observations: Observations) -> Observations:
    return {name: batch[0] for name, batch in observations.items()}


def _first_info(info: Info) -> Scalars:
    return {name: batch[0].item() for name, batch in info.items() if not name.startswith("_")}
