"""Geometry against the figures of the original environments, and shortest paths."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from midway.envs.geodesic import distance_field, geodesic_distance, shares_of_hard, way_left
from midway.envs.mazes import MAZES, Rectangle
from midway.errors import ConfigurationError

mazes = st.sampled_from(list(MAZES.values()))
unit = st.tuples(st.floats(0, 1), st.floats(0, 1))


def centre(box):
    return np.array((box.x, box.y))


def in_arena(maze, share):
    low, high = np.array(maze.arena.low), np.array(maze.arena.high)
    return low + np.array(share) * (high - low)


def depth_in_walls(maze, point):
    """Return the largest max-norm depth of a point below the surface of any wall (m)."""
    return max(
        min(wall.half_x - abs(point[0] - wall.x), wall.half_y - abs(point[1] - wall.y))
        for wall in maze.walls
    )


# Walls as (low x, high x, low y, high y), arena half sizes, and the share of the arena where a
# point of radius 0.75 is free, as measured in the original environments.
FIGURES = {
    "u": ([(-0.75, 0.75, -6, 9)], (3.75, 9.0), 0.40),
    "s": ([(-3, -1.5, -3, 6), (1.5, 3, -6, 3)], (6.0, 6.0), 0.39),
    "pi": (
        [
            (0.75, 4, 2.5, 4),
            (-4, -0.75, 2.5, 4),
            (-0.75, 0.75, -4, 8),
            (4, 8, -3, -1.5),
            (-8, -4, -3, -1.5),
        ],
        (8.0, 8.0),
        0.51,
    ),
    "omega": (
        [(-3, 3, -4, -2.5), (-4.5, -3, -4, 4), (3, 4.5, -4, 4), (-0.75, 0.75, -8, -4)],
        (8.0, 8.0),
        0.52,
    ),
}

OUTER_WALLS = {
    "u": {(0, 10, 3.75, 1), (0, -10, 3.75, 1), (4.75, 0, 1, 11), (-4.75, 0, 1, 11)},
    "s": {(0, 7, 6, 1), (0, -7, 6, 1), (7, 0, 1, 8), (-7, 0, 1, 8)},
    "pi": {(0, 9, 8, 1), (0, -9, 8, 1), (9, 0, 1, 10), (-9, 0, 1, 10)},
    "omega": {(0, 9, 8, 1), (0, -9, 8, 1), (9, 0, 1, 10), (-9, 0, 1, 10)},
}

# Straight and shortest way (m) between the centres of the test boxes, the latter measured on a
# grid in the original environments.
DISTANCES = [
    ("u", "hard", 4.5, 31.6),
    ("s", "hard", 12.7, 30.2),
    ("pi", "hard", 4.5, 29.4),
    ("omega", "hard", 4.5, 36.2),
    *[
        ("s", f"case-{10 + i}", None, distance)
        for i, distance in enumerate((4.5, 9.0, 12.2, 15.1, 19.6, 22.8, 25.7, 30.2))
    ],
    *[
        ("omega", f"case-{10 + i}", None, distance)
        for i, distance in enumerate((8.3, 14.3, 18.3, 21.1, 24.6, 28.2, 36.2))
    ],
]


@pytest.mark.parametrize("name", MAZES)
def test_walls_are_those_of_the_original(name):
    maze = MAZES[name]
    walls, half_size, free_share = FIGURES[name]
    assert [(w.low[0], w.high[0], w.low[1], w.high[1]) for w in maze.inner_walls] == walls
    assert maze.arena == Rectangle(0.0, 0.0, *half_size)
    assert {(w.x, w.y, w.half_x, w.half_y) for w in maze.outer_walls} == OUTER_WALLS[name]
    points = np.random.default_rng(0).uniform(maze.arena.low, maze.arena.high, (20_000, 2))
    assert maze.free(points).mean() == pytest.approx(free_share, abs=0.015)


def test_tasks_are_those_of_the_paper():
    numbered = {"s": range(10, 18), "omega": range(10, 17)}
    for name, maze in MAZES.items():
        cases = [f"case-{number}" for number in numbered.get(name, ())]
        assert list(maze.cases) == ["uniform", "hard", *cases]
        assert maze.cases["uniform"].start == maze.cases["uniform"].goal == maze.arena
        if cases:
            assert maze.cases[cases[-1]] == maze.cases["hard"]
        for task in ("hard", *cases):
            case = maze.cases[task]
            for box in (case.start, case.goal):
                assert (box.half_x, box.half_y) == (0.25, 0.25)
                corners = np.array([box.low, box.high])
                assert maze.free(corners).all()


@pytest.mark.parametrize(("name", "task", "straight", "shortest"), DISTANCES)
def test_distances_of_the_test_cases(name, task, straight, shortest):
    maze = MAZES[name]
    start, goal = (centre(box) for box in (maze.cases[task].start, maze.cases[task].goal))
    if straight is not None:
        assert np.linalg.norm(goal - start) == pytest.approx(straight, abs=0.05)
    # 1 %: the figures were measured on a grid; ours are exact for the rectangles grown by 0.75.
    assert geodesic_distance(maze, start, goal) == pytest.approx(shortest, rel=0.01)


def test_ways_are_shares_of_the_hard_tasks():
    maze = MAZES["s"]
    start = centre(maze.cases["hard"].start)
    goals = [centre(maze.cases[task].goal) for task in ("hard", "case-10", "case-13")]
    shares = shares_of_hard(maze, np.stack(3 * [start]), np.stack(goals))
    np.testing.assert_allclose(shares, [1, 4.5 / 30.2, 15.1 / 30.2], atol=0.005)
    corner, wall = np.array((-3.0, 8.25)), np.array((0.0, 0.0))
    pairs = np.stack([corner, wall]), np.stack([np.array((3.0, 8.25)), corner])
    assert shares_of_hard(MAZES["u"], *pairs).tolist() == [1, 1]


def test_distance_around_one_wall_worked_by_hand():
    start, goal = np.array((-2.25, 7.5)), np.array((2.25, 7.5))
    by_hand = 2 * np.hypot(0.75, 7.5 + 6.75) + 3
    assert geodesic_distance(MAZES["u"], start, goal) == pytest.approx(by_hand, abs=1e-4)
    narrow = 2 * np.hypot(1.5, 7.5 + 6) + 1.5
    assert geodesic_distance(MAZES["u"], start, goal, radius=0.0) == pytest.approx(narrow, abs=1e-4)


def test_distance_is_infinite_from_and_to_walls():
    free, wall = np.array((-2.25, 7.5)), np.array((0.0, 0.0))
    maze = MAZES["u"]
    assert np.isinf(geodesic_distance(maze, wall, free))
    assert np.isinf(geodesic_distance(maze, free, wall))
    assert np.isinf(geodesic_distance(maze, np.array((20.0, 0.0)), free))


@settings(deadline=None)
@given(mazes, unit, st.floats(0, 1.2))
def test_free_points_are_those_outside_the_grown_walls(maze, share, radius):
    point = in_arena(maze, share)
    depth = depth_in_walls(maze, point) + radius
    assume(abs(depth) > 1e-9)
    assert maze.free(point, radius) == (depth < 0)


@settings(deadline=None)
@given(mazes, st.integers(0, 2**32), st.floats(0, 1.25))
def test_sampled_points_are_free_and_in_their_box(maze, seed, radius):
    rng = np.random.default_rng(seed)
    for case in maze.cases.values():
        point = maze.sample_point(rng, case.goal, radius if case.goal == maze.arena else 0.75)
        assert case.goal.contains(point)
        assert depth_in_walls(maze, point) <= (-radius if case.goal == maze.arena else -0.75) + 1e-9


@settings(max_examples=60, deadline=None)
@given(mazes, st.integers(0, 2**32))
def test_shortest_paths_are_a_metric(maze, seed):
    rng = np.random.default_rng(seed)
    a, b, c = (maze.sample_point(rng, maze.arena) for _ in range(3))
    ab = geodesic_distance(maze, a, b)
    assert np.isfinite(ab)
    assert ab >= np.linalg.norm(b - a) - 1e-9
    assert ab == pytest.approx(geodesic_distance(maze, b, a), abs=1e-5)
    assert ab <= geodesic_distance(maze, a, c) + geodesic_distance(maze, c, b) + 1e-5
    line = a + np.linspace(0, 1, 200)[:, None] * (b - a)
    clear = maze.free(line, 0.76).all()
    blocked = not maze.free(line, 0.75).all()
    if clear:
        assert ab == pytest.approx(np.linalg.norm(b - a), abs=1e-9)
    if blocked:
        assert ab > np.linalg.norm(b - a)


@settings(deadline=None)
@given(mazes, st.integers(0, 2**32))
def test_start_and_goal_keep_apart(maze, seed):
    rng = np.random.default_rng(seed)
    goal = np.array((maze.cases["hard"].goal.x, maze.cases["hard"].goal.y))
    start, same = maze.sample_start_and_goal(rng, "uniform", 3.0, goal=goal)
    assert same is goal
    assert np.linalg.norm(start - goal) >= 3
    start, drawn = maze.sample_start_and_goal(rng, "uniform", 3.0, start=goal)
    assert start is goal
    assert np.linalg.norm(drawn - goal) >= 3
    assert maze.sample_start_and_goal(rng, "hard", 3.0, start=goal, goal=goal) == (goal, goal)


def test_impossible_draws_end():
    maze = MAZES["u"]
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigurationError, match="no free point"):
        maze.sample_point(rng, maze.inner_walls[0])
    with pytest.raises(ConfigurationError, match="at the goal"):
        maze.sample_start_and_goal(rng, "hard", 1.0, goal=np.array((-2.25, 7.5)))


@pytest.mark.parametrize("maze", MAZES.values(), ids=MAZES)
def test_distance_field_is_the_distance_at_its_points(maze):
    goal = centre(maze.cases["hard"].goal)
    field = distance_field(maze, goal, spacing=0.5)
    assert field.distance.shape == (len(field.y), len(field.x))
    assert field.distance.min() == pytest.approx(0, abs=0.5)
    row, column = np.argwhere(np.isfinite(field.distance))[7]
    point = np.array((field.x[column], field.y[row]))
    assert geodesic_distance(maze, point, goal) == field.distance[row, column]
    free = maze.free(np.stack(np.meshgrid(field.x, field.y), axis=-1))
    np.testing.assert_array_equal(np.isfinite(field.distance), free)


@pytest.mark.parametrize("maze", MAZES.values(), ids=lambda maze: maze.name)
def test_the_way_left_bends_around_walls_and_is_known_wherever_a_robot_may_be(maze):
    case = maze.cases["hard"]
    start, goal = np.array([case.start.x, case.start.y]), np.array([case.goal.x, case.goal.y])
    wall = maze.inner_walls[0]
    pressed = np.array(
        [[wall.low[0] - 0.21, wall.y], [wall.x, wall.high[1] + 0.21], [wall.x, wall.y]]
    )
    left = way_left(maze, np.concatenate([start[None], pressed]), goal)
    assert left[0] > 1.3 * np.linalg.norm(goal - start)
    assert np.isfinite(left).all()
    assert (left[1:] >= np.linalg.norm(goal - pressed, axis=1) - 1e-9).all()
