"""What the robots in mazes have in common: walls, starts, goals and success."""

from abc import abstractmethod
from typing import ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Float32, Int, UInt8

from midway.envs.geodesic import shares_of_hard
from midway.envs.mazes import WALL_HEIGHT, Maze
from midway.envs.rendering import Renderer, camera_above
from midway.envs.simulation import SimulationVectorEnv
from midway.envs.vector import Array
from midway.errors import ConfigurationError
from midway.types import DistanceTask, EnvSpec, Observations, Options

GOAL_THRESHOLD = 0.5
"""Distance in x-y below which the goal is reached (m); paper, appendix C."""

ROUNDING = 1e-5
"""More than float32 rounding can take from a distance in a maze (m)."""


PICTURE_SIDE = 480
"""Rows and columns of a picture."""

RIM = 2.0
"""What a picture shows around the arena, the outer walls (m)."""

WALL, FLOOR, ROBOT = (0.35, 0.37, 0.4, 1.0), (0.8, 0.8, 0.78, 1.0), (0.85, 0.4, 0.1, 1.0)
"""Colours in pictures."""

LARGEST_IN_SPREADS = 3.0
"""How many deviations from the middle the far wall lies, at most."""


class MazeVectorEnv(SimulationVectorEnv):
    """A robot in a maze whose observation is its full state and whose goals are full states.

    A subclass implements ``_pose`` and ``_encode``.

    Args:
        maze: The maze, which the model's walls are of.
        model: The MuJoCo model of one copy.
        name: The name that users type.
        num_envs: Number of copies.
        task: The first current task.
        observation_box: Bounds of one observation, and so of one goal.
        max_episode_steps: Steps after which an episode is truncated.
        substeps: Simulation steps for each environment step.
        num_threads: Threads that simulate, 0 for one per core.

    Raises:
        ConfigurationError: As ``GoalVectorEnv``.
    """

    option_names = (*SimulationVectorEnv.option_names, "start", "goal")
    center: ClassVar[tuple[float, ...]] = ()
    """Typical middle of each entry of the observation, where it is known."""
    spread: ClassVar[tuple[float, ...]] = ()
    """Typical deviation of each entry from it; x and y in one unit."""
    body_radius: float
    """Radius of the robot's solid middle (m), which no start or goal can have in a wall."""

    def __init__(
        self,
        maze: Maze,
        model: mujoco.MjModel,
        name: str,
        num_envs: int,
        task: str,
        observation_box: spaces.Box,
        max_episode_steps: int,
        substeps: int,
        num_threads: int = 0,
    ) -> None:
        self.maze = maze
        self._model = model
        self._renderer: Renderer | None = None
        goal_spec = EnvSpec(
            name=name,
            observation_shape=observation_box.shape,
            observation_dtype="float32",
            goal_shape=observation_box.shape,
            action_dim=model.nu,
            max_episode_steps=max_episode_steps,
            goal_is_observation=True,
            state_shape=None,
            task=DistanceTask(groups=((0, 1),), threshold=GOAL_THRESHOLD),
            center=self.center,
            spread=_spread(self.spread, maze),
        )
        super().__init__(
            model=model,
            goal_spec=goal_spec,
            num_envs=num_envs,
            tasks=tuple(maze.cases),
            task=task,
            observation_box=observation_box,
            goal_box=observation_box,
            substeps=substeps,
            num_threads=num_threads,
        )

    @abstractmethod
    def _pose(
        self, rng: np.random.Generator, position: Float[Array, "2"]
    ) -> Float[Array, " num_positions"]:
        """Return the joint positions of a start or goal at this x-y (m)."""

    @abstractmethod
    def _encode(
        self, qpos: Float[Array, "n num_positions"], qvel: Float[Array, "n num_velocities"]
    ) -> Float32[Array, "n observation_dim"]:
        """Return the observations of these states."""

    def render(self) -> tuple[UInt8[Array, "h w 3"], ...]:
        """Return a picture of each copy from above, with a disc at its goal.

        Raises:
            ConfigurationError: Nothing here can draw.
        """
        if self._renderer is None:
            arena = self.maze.arena
            _paint(self._model)
            half = max(arena.half_x, arena.half_y) + RIM
            self._renderer = Renderer(self._model, camera_above(arena.x, arena.y, half))
        goals = self._goals["desired_goal"][:, :2].astype(np.float64)
        return tuple(self._renderer.draw(self._qpos, goals))

    def ways(self) -> Float[Array, " num_envs"]:
        """Return the shortest paths to the goals, as shares of that of the task ``hard``."""
        here, goals = (each[:, :2] for each in self.success_pair(self._observe()))
        return shares_of_hard(self.maze, here, goals)

    def _achieved(self) -> Observations:
        observation = self._encode(self._qpos, self._qvel)
        return {"observation": observation, "achieved_goal": observation.copy()}

    def _place(self, copies: Int[Array, " n"], options: Options) -> None:
        given = [self._given(options.get(role), role) for role in ("start", "goal")]
        starts, goals = [], []
        for copy in copies:
            rng = self.generators[copy]
            start, goal = self.maze.sample_start_and_goal(
                rng, self.task, GOAL_THRESHOLD + ROUNDING, *(points[copy] for points in given)
            )
            goals.append(self._pose(rng, goal))
            starts.append(self._pose(rng, start))
        self._qpos[copies] = starts
        at_rest = np.zeros((len(copies), self._qvel.shape[1]))
        self._goals["desired_goal"][copies] = self._encode(np.stack(goals), at_rest)

    def _given(self, points: object, role: str) -> list[Float[Array, "2"] | None]:
        """Return for each copy the start or goal that the user's options name, if they do.

        Raises:
            ConfigurationError: A point in a wall or outside the maze, or of the wrong shape.
        """
        if points is None:
            return [None] * self.num_envs
        try:
            points = np.broadcast_to(np.asarray(points, np.float64), (self.num_envs, 2))
        except ValueError:
            raise ConfigurationError(
                f"{role} {points!r}: must be an x-y position, or one for each copy"
            ) from None
        if not self.maze.free(points, self.body_radius).all():
            raise ConfigurationError(
                f"{role} {points.tolist()}: must be in the maze and {self.body_radius} m from walls"
            )
        return list(points)


def _paint(model: mujoco.MjModel) -> None:
    """Set size, light and colours of pictures; the physics knows nothing of them."""
    model.vis.global_.offwidth = model.vis.global_.offheight = PICTURE_SIDE
    model.vis.headlight.ambient[:] = 0.6
    for number in range(model.ngeom):
        geom = model.geom(number)
        is_wall = geom.name.startswith(("inner-", "outer-"))
        is_floor = geom.type == mujoco.mjtGeom.mjGEOM_PLANE.value
        model.geom_matid[number] = -1
        model.geom_rgba[number] = WALL if is_wall else FLOOR if is_floor else ROBOT


def _spread(spread: tuple[float, ...], maze: Maze) -> tuple[float, ...]:
    """Return the deviations of a robot in this maze: those of x and y grow with large ones."""
    largest = max(maze.arena.half_x, maze.arena.half_y) / LARGEST_IN_SPREADS
    return (*(max(x, largest) for x in spread[:2]), *spread[2:])


def walls_mjcf(maze: Maze, inner: str, outer: str) -> str:
    """Return the walls of a maze as MJCF, with these attributes of inner and outer walls.

    The boxes are centred on the floor, so half of each is below it (original environment).
    """
    return "\n".join(
        f'<geom name="{kind}-{number}" type="box" pos="{wall.x} {wall.y} 0" '
        f'size="{wall.half_x} {wall.half_y} {WALL_HEIGHT}" {attributes}/>'
        for kind, walls, attributes in (
            ("inner", maze.inner_walls, inner),
            ("outer", maze.outer_walls, outer),
        )
        for number, wall in enumerate(walls, start=1)
    )
