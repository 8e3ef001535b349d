"""Shortest paths through mazes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse.csgraph import dijkstra

from midway.envs.mazes import ROBOT_RADIUS, Maze

CLEARANCE = 1e-6
"""Distance of path corners from grown walls (m), so that paths along a wall do not touch it."""


OBSERVED = ROBOT_RADIUS - 1e-3
"""Distance from walls (m) of points that were drawn free and rounded to float32."""

NARROW = 0.2
"""Distance from walls (m) that no robot in a maze falls below, as it is pressed against one."""


class DistanceField(NamedTuple):
    """Distances to one goal on a grid of points."""

    x: Float[np.ndarray, " columns"]
    y: Float[np.ndarray, " rows"]
    distance: Float[np.ndarray, "rows columns"]


def geodesic_distance(
    maze: Maze,
    start: Float[np.ndarray, "*batch 2"],
    goal: Float[np.ndarray, "2"],
    radius: float = ROBOT_RADIUS,
) -> Float[np.ndarray, "*batch"]:
    """Return the length of the shortest paths (m) that keep ``radius`` from every wall.

    Walls are grown by ``radius`` as rectangles, as where points are rejected, and a path bends
    only at their corners. A round robot could cut each right-angled corner by up to 0.43 times
    the radius. From or to a point that is not free the distance is infinite.
    """
    start = np.asarray(start, np.float64)
    goal = np.asarray(goal, np.float64)
    nodes = np.concatenate([_free_corners(maze, radius), goal[None]])
    lengths = _lengths(maze, nodes, nodes, radius)
    from_node = dijkstra(np.where(np.isfinite(lengths), lengths, 0), directed=False, indices=-1)
    points = start.reshape(-1, 2)
    distance = (_lengths(maze, points, nodes, radius) + from_node).min(axis=1)
    distance[~maze.free(points, radius)] = np.inf
    if not maze.free(goal, radius):
        distance[:] = np.inf
    return np.asarray(distance.reshape(start.shape[:-1]))


def shares_of_hard(
    maze: Maze, starts: Float[np.ndarray, "n 2"], goals: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Return the lengths of shortest paths as shares of the hard task's, at most 1.

    The hard task's is that between the middles of its boxes. A way from or to a point at a wall,
    where no start or goal is drawn, counts as 1.
    """
    hard = maze.cases["hard"]
    ends = np.array([[box.x, box.y] for box in (hard.start, hard.goal)])
    pairs = zip([ends[0], *starts], [ends[1], *goals], strict=True)
    longest, *ways = (float(geodesic_distance(maze, *pair, OBSERVED)) for pair in pairs)
    return np.minimum(1.0, np.array(ways) / longest)


def way_left(
    maze: Maze, points: Float[np.ndarray, "T 2"], goal: Float[np.ndarray, "2"]
) -> Float[np.ndarray, " T"]:
    """Return how far the goal is from each place of an episode, along the corridors (m).

    Unlike `geodesic_distance` this is finite wherever a robot may be, close to walls too.
    """
    straight = np.linalg.norm(points - goal, axis=-1)
    along = geodesic_distance(maze, points, goal, NARROW)
    return np.where(np.isfinite(along), along, straight)


def distance_field(
    maze: Maze,
    goal: Float[np.ndarray, "2"],
    spacing: float = 0.25,
    radius: float = ROBOT_RADIUS,
) -> DistanceField:
    """Return the geodesic distance to ``goal`` (m) at points over the arena, ``spacing`` apart."""
    x, y = (
        np.linspace(low, high, round((high - low) / spacing) + 1)
        for low, high in zip(maze.arena.low, maze.arena.high, strict=True)
    )
    points = np.stack(np.meshgrid(x, y), axis=-1)
    return DistanceField(x, y, geodesic_distance(maze, points, goal, radius))


def _free_corners(maze: Maze, radius: float) -> Float[np.ndarray, "corners 2"]:
    """Return the corners of the grown walls that a robot can stand at."""
    walls = [wall.grown(radius + CLEARANCE) for wall in maze.inner_walls]
    corners = np.array(
        [(x, y) for w in walls for x in (w.low[0], w.high[0]) for y in (w.low[1], w.high[1])]
    )
    return np.asarray(corners[maze.free(corners, radius)])


def _lengths(
    maze: Maze,
    starts: Float[np.ndarray, "n 2"],
    ends: Float[np.ndarray, "m 2"],
    radius: float,
) -> Float[np.ndarray, "n m"]:
    """Return the lengths of straight lines (m), infinite for those through a grown wall."""
    lengths = np.asarray(np.linalg.norm(ends - starts[:, None], axis=-1))
    lengths[_blocked(maze, starts, ends, radius)] = np.inf
    return lengths


def _blocked(
    maze: Maze,
    starts: Float[np.ndarray, "n 2"],
    ends: Float[np.ndarray, "m 2"],
    radius: float,
) -> Bool[np.ndarray, "n m"]:
    """Return which straight lines pass through the inside of a grown wall.

    Along each axis a line ``start + t (end - start)`` is between the wall's sides for an
    interval of t; it is inside where the two intervals and [0, 1] overlap.
    """
    origin = starts[:, None]
    direction = ends - origin
    still = direction == 0
    slope = np.where(still, 1, direction)
    blocked = np.zeros(direction.shape[:2], np.bool_)
    for wall in maze.inner_walls:
        grown = wall.grown(radius)
        low, high = np.array(grown.low), np.array(grown.high)
        crossings = np.stack([(low - origin) / slope, (high - origin) / slope])
        between = (low < origin) & (origin < high)
        enter = np.where(still, np.where(between, -np.inf, np.inf), crossings.min(axis=0))
        leave = np.where(still, np.inf, crossings.max(axis=0))
        blocked |= np.maximum(enter.max(axis=-1), 0) < np.minimum(leave.min(axis=-1), 1)
    return blocked
