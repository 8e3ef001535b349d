"""Maze geometry as data: the one source for physics, sampling, distances and plots.

Lengths in metres, x to the right and y up. Walls and boxes are axis-aligned rectangles. The
numbers are those of the original environments (paper, appendix C).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float

from midway.errors import ConfigurationError

WALL_HEIGHT = 1.0
"""Height of every wall above the floor (m)."""

ROBOT_RADIUS = 0.75
"""Distance that start and goal points keep from every wall (m)."""

MAX_DRAWS = 1000
"""Rounds of random draws before giving up; the worst maze accepts 39 % of the points."""

POINTS_PER_DRAW = 8
"""Points drawn at once, of which the first free one is taken: quicker than one after another."""


@dataclass(frozen=True)
class Rectangle:
    """An axis-aligned rectangle.

    Attributes:
        x: Centre, x (m).
        y: Centre, y (m).
        half_x: Half extent in x (m).
        half_y: Half extent in y (m).
    """

    x: float
    y: float
    half_x: float
    half_y: float

    @property
    def low(self) -> tuple[float, float]:
        """Lower left corner (m)."""
        return self.x - self.half_x, self.y - self.half_y

    @property
    def high(self) -> tuple[float, float]:
        """Upper right corner (m)."""
        return self.x + self.half_x, self.y + self.half_y

    def grown(self, margin: float) -> "Rectangle":
        """Return the rectangle grown by ``margin`` (m) on every side."""
        return Rectangle(self.x, self.y, self.half_x + margin, self.half_y + margin)

    def contains(
        self, points: Float[np.ndarray, "*batch 2"], strictly: bool = False
    ) -> Bool[np.ndarray, "*batch"]:
        """Return whether points are inside; the border counts unless ``strictly``."""
        offset = np.abs(points - np.array((self.x, self.y)))
        half = np.array((self.half_x, self.half_y))
        inside: Bool[np.ndarray, "*batch"] = np.all(
            offset < half if strictly else offset <= half, axis=-1
        )
        return np.asarray(inside)


@dataclass(frozen=True)
class Case:
    """A task in a maze: the boxes that start and goal are drawn from."""

    start: Rectangle
    goal: Rectangle


@dataclass(frozen=True)
class Maze:
    """A walled arena with its tasks.

    Attributes:
        name: ``u``, ``s``, ``pi`` or ``omega``.
        title: Name in the paper.
        arena: The interior; four outer walls stand around it.
        inner_walls: Walls inside the arena.
        cases: Tasks by name: ``uniform`` (training), ``hard`` (the paper's test) and, in S and
            omega, goals of growing distance ``case-10``, ``case-11``, ...
    """

    name: str
    title: str
    arena: Rectangle
    inner_walls: tuple[Rectangle, ...]
    cases: Mapping[str, Case]

    @property
    def outer_walls(self) -> tuple[Rectangle, ...]:
        """The four walls, 2 m thick, around the arena."""
        half_x, half_y = self.arena.half_x, self.arena.half_y
        return (
            Rectangle(0.0, half_y + 1, half_x, 1.0),
            Rectangle(0.0, -half_y - 1, half_x, 1.0),
            Rectangle(half_x + 1, 0.0, 1.0, half_y + 2),
            Rectangle(-half_x - 1, 0.0, 1.0, half_y + 2),
        )

    @property
    def walls(self) -> tuple[Rectangle, ...]:
        """Inner and outer walls."""
        return self.inner_walls + self.outer_walls

    def free(
        self, points: Float[np.ndarray, "*batch 2"], radius: float = ROBOT_RADIUS
    ) -> Bool[np.ndarray, "*batch"]:
        """Return whether points lie in the arena and in no wall grown by ``radius`` (m).

        A point on the border of a grown wall is free (rejection rule of the original environment).
        """
        free = self.arena.grown(-radius).contains(points)
        for wall in self.inner_walls:
            free &= ~wall.grown(radius).contains(points, strictly=True)
        return free

    def sample_point(
        self, rng: np.random.Generator, box: Rectangle, radius: float = ROBOT_RADIUS
    ) -> Float[np.ndarray, "2"]:
        """Draw a free point, uniform in ``box`` (m).

        Raises:
            ConfigurationError: The box holds no free point.
        """
        for _ in range(MAX_DRAWS):
            points = rng.uniform(box.low, box.high, (POINTS_PER_DRAW, 2))
            free = self.free(points, radius)
            if free.any():
                return np.asarray(points[free.argmax()])
        raise ConfigurationError(f"maze {self.name!r}: no free point in {box}")

    def sample_start_and_goal(
        self,
        rng: np.random.Generator,
        task: str,
        apart: float,
        start: Float[np.ndarray, "2"] | None = None,
        goal: Float[np.ndarray, "2"] | None = None,
    ) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Draw the goal, then a start at least ``apart`` (m) from it, of a task.

        A point that is given is kept as it is; with both given nothing is drawn.

        Raises:
            ConfigurationError: No start and goal are so far apart.
        """
        case = self.cases[task]
        goal_point = self.sample_point(rng, case.goal) if goal is None else goal
        start_point = self.sample_point(rng, case.start) if start is None else start
        both_given = start is not None and goal is not None
        for _ in range(MAX_DRAWS):
            if both_given or np.linalg.norm(start_point - goal_point) >= apart:
                return start_point, goal_point
            if start is None:
                start_point = self.sample_point(rng, case.start)
            else:
                goal_point = self.sample_point(rng, case.goal)
        raise ConfigurationError(f"maze {self.name!r}, task {task!r}: start always at the goal")


def _test_box(low_x: float, low_y: float) -> Rectangle:
    """Return the box of 0.5 x 0.5 m with this lower left corner."""
    return Rectangle(low_x + 0.25, low_y + 0.25, 0.25, 0.25)


def _maze(
    name: str,
    title: str,
    half: tuple[float, float],
    inner_walls: tuple[Rectangle, ...],
    start: tuple[float, float],
    goal: tuple[float, float],
    numbered_goals: tuple[tuple[float, float], ...] = (),
) -> Maze:
    """Build a maze from its arena's half size, walls, and lower left corners of the test boxes."""
    arena = Rectangle(0.0, 0.0, *half)
    cases = {"uniform": Case(arena, arena), "hard": Case(_test_box(*start), _test_box(*goal))}
    for number, corner in enumerate(numbered_goals, start=10):
        cases[f"case-{number}"] = Case(_test_box(*start), _test_box(*corner))
    return Maze(name, title, arena, inner_walls, MappingProxyType(cases))


_U = _maze(
    "u",
    "U-shaped",
    half=(3.75, 9.0),
    inner_walls=(Rectangle(0.0, 1.5, 0.75, 7.5),),
    start=(-2.5, 7.25),
    goal=(2.0, 7.25),
)

_S = _maze(
    "s",
    "S-shaped",
    half=(6.0, 6.0),
    inner_walls=(Rectangle(-2.25, 1.5, 0.75, 4.5), Rectangle(2.25, -1.5, 0.75, 4.5)),
    start=(-4.75, 4.25),
    goal=(4.25, -4.75),
    numbered_goals=(
        (-4.75, -0.25),
        (-4.75, -4.75),
        (-0.25, -4.75),
        (-0.25, -0.25),
        (-0.25, 4.25),
        (4.25, 4.25),
        (4.25, -0.25),
        (4.25, -4.75),
    ),
)

_PI = _maze(
    "pi",
    "Π-shaped",
    half=(8.0, 8.0),
    inner_walls=(
        Rectangle(2.375, 3.25, 1.625, 0.75),
        Rectangle(-2.375, 3.25, 1.625, 0.75),
        Rectangle(0.0, 2.0, 0.75, 6.0),
        Rectangle(6.0, -2.25, 2.0, 0.75),
        Rectangle(-6.0, -2.25, 2.0, 0.75),
    ),
    start=(-2.5, 6.25),
    goal=(2.0, 6.25),
)

_OMEGA = _maze(
    "omega",
    "ω-shaped",
    half=(8.0, 8.0),
    inner_walls=(
        Rectangle(0.0, -3.25, 3.0, 0.75),
        Rectangle(-3.75, 0.0, 0.75, 4.0),
        Rectangle(3.75, 0.0, 0.75, 4.0),
        Rectangle(0.0, -6.0, 0.75, 2.0),
    ),
    start=(-2.5, -6.75),
    goal=(2.0, -6.75),
    numbered_goals=(
        (-6.5, -0.25),
        (-6.5, 5.75),
        (-0.25, 5.75),
        (-0.25, -0.25),
        (6.0, 5.75),
        (6.0, -0.25),
        (2.0, -6.75),
    ),
)

MAZES: Mapping[str, Maze] = MappingProxyType({maze.name: maze for maze in (_U, _S, _PI, _OMEGA)})
"""The four mazes of the paper by name."""
