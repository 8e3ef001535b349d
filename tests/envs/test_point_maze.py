"""The ball moves as documented, walls block it, and every maze can be solved in time."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from midway.envs.geodesic import geodesic_distance
from midway.envs.mazes import MAZES
from midway.envs.registry import make_vec
from midway.errors import ConfigurationError

every_maze = pytest.mark.parametrize("shape", MAZES)


def test_observation_is_position_and_velocity():
    env = make_vec("point-u", 2)
    starts, goals = [(-2.25, 7.5), (2.0, -7.0)], [(2.25, 7.5), (-2.0, 0.0)]
    observations, info = env.reset(options={"start": starts, "goal": goals})
    np.testing.assert_array_equal(observations["observation"], np.c_[starts, np.zeros((2, 2))])
    np.testing.assert_array_equal(observations["desired_goal"], np.c_[goals, np.zeros((2, 2))])
    np.testing.assert_allclose(info["distance"], [4.5, np.hypot(4, 7)], rtol=1e-6)


def test_full_speed_is_half_a_metre_per_step():
    env = make_vec("point-u", 1)
    env.reset(seed=0, options={"start": (-2.25, 7.5), "goal": (2.25, 7.5)})
    seen = np.stack([env.step(np.array([[0.0, -3.0]]))[0]["observation"][0] for _ in range(5)])
    steps = -np.diff(seen[:, 1], prepend=7.5)
    assert 0.4 < steps[0] < 0.5
    np.testing.assert_allclose(steps[1:], 0.5, atol=0.002)
    np.testing.assert_allclose(seen[-1], [-2.25, seen[-1, 1], 0, -1], atol=1e-3)


def distance_to_walls(maze, points):
    """Return the Euclidean distances of points from the nearest wall (m)."""
    distances = []
    for wall in maze.walls:
        outside = np.abs(points - (wall.x, wall.y)) - (wall.half_x, wall.half_y)
        distances.append(np.linalg.norm(np.maximum(outside, 0), axis=-1))
    return np.min(distances, axis=0)


@every_maze
def test_walls_block_the_ball_from_everywhere(shape):
    maze, copies = MAZES[shape], 192
    rng = np.random.default_rng(0)
    env = make_vec(f"point-{shape}", copies)
    starts = np.stack([maze.sample_point(rng, maze.arena, 0.41) for _ in range(copies)])
    env.reset(seed=0, options={"start": starts})
    angles = np.linspace(0, 2 * np.pi, copies, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    env._apply(directions / np.abs(directions).max(axis=1, keepdims=True))
    for _ in range(120):
        # Each simulation step is looked at: it moves the ball by 0.18 m at most.
        env.batch.step()
        assert (distance_to_walls(maze, env.batch.qpos) > 0.2).all()
    observations = env._observe()
    assert env.observation_space.contains(observations)
    pressed = distance_to_walls(maze, env.batch.qpos) < 0.4
    assert pressed.mean() > 0.7


@every_maze
def test_the_test_task_can_be_solved_in_time(shape):
    maze = MAZES[shape]
    env = make_vec(f"point-{shape}", 4, task="hard")
    observations, _ = env.reset(seed=0)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 0.4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reached = np.zeros(4, bool)
    for _ in range(env.goal_spec.max_episode_steps):
        positions = observations["achieved_goal"][:, None, :2].astype(np.float64)
        goals = observations["desired_goal"][:, :2].astype(np.float64)
        around = positions + ring
        ahead = [geodesic_distance(maze, around[i], goals[i], radius=0.5) for i in range(4)]
        best = ring[np.argmin(ahead, axis=1)]
        actions = best / np.abs(best).max(axis=1, keepdims=True)
        observations, _, terminated, truncated, _ = env.step(actions)
        reached |= terminated
        if reached.all():
            break
        if terminated.any():
            mask = terminated | truncated
            observations, _ = env.reset(options={"reset_mask": mask})
    assert reached.all()


def test_environments_know_how_far_their_goals_are():
    env = make_vec("point-s", 2)
    env.reset(seed=0, options={"task": "case-10"})
    np.testing.assert_allclose(env.ways(), 4.5 / 30.2, atol=0.04)
    env.reset(seed=0, options={"task": "hard"})
    np.testing.assert_allclose(env.ways(), 1, atol=0.04)


def test_an_episode_that_stands_still_is_cut_off_at_its_limit():
    env = make_vec("point-s", 2)
    env.reset(seed=0)
    for step in range(1, 151):
        _, _, terminated, truncated, info = env.step(np.zeros((2, 2)))
        assert not terminated.any()
        assert (truncated == (step == 150)).all()
        np.testing.assert_array_equal(info["elapsed_steps"], step)


@pytest.mark.parametrize("point", [(0.0, 0.0), (30.0, 0.0), (1.0, 2.0, 3.0)])
def test_a_start_in_a_wall_is_refused(point):
    env = make_vec("point-u", 2)
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="start"):
        env.reset(options={"start": point})
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 2)))
