"""How an environment is drawn from above; an environment without a view has none of these."""

from dataclasses import dataclass
from typing import TypeAlias

from midway.envs.mazes import Maze


@dataclass(frozen=True)
class MazeView:
    """A robot in a maze, whose observations and goals begin with its x-y position (m).

    Attributes:
        maze: The maze.
        upright: Entries of the observation whose product is the cosine of the robot's tilt; nothing
            for a robot that cannot fall.
    """

    maze: Maze
    upright: tuple[int, int] | None = None

    position = slice(0, 2)
    """x and y in observations and goals (m)."""


@dataclass(frozen=True)
class TableView:
    """A table with a hand and a puck, whose states are hand x, y and puck x, y (m)."""

    hand = slice(0, 2)
    puck = slice(2, 4)


View: TypeAlias = MazeView | TableView
