"""The arm against the figures of the original, and the physics of pushing."""

import mujoco
import numpy as np
import pytest

from midway.envs.arm import HAND_ROTATION, LINKS, RESTING_JOINT, Arm
from midway.envs.push import ACTION_SCALE, GOAL_THRESHOLD
from midway.envs.push_scene import (
    CLEARANCE,
    HAND_BOX,
    PUCK_BOX,
    PUCK_HEIGHT,
    TASKS,
    push_model,
)
from midway.envs.registry import make_vec
from midway.errors import ConfigurationError

PUCK_LIMITS = np.array(((-0.189, 0.511), (0.189, 0.689)))
"""Lowest and highest x, y of a puck that lies on the table within the boundary (m)."""


def grid(box, columns=9, rows=5):
    """Return points of a box with its corners, (columns * rows, 2)."""
    sizes = (columns, rows)
    axes = np.meshgrid(*map(np.linspace, box.low, box.high, sizes))
    return np.stack(axes, axis=-1).reshape(-1, 2)


def hands_and_pucks():
    """Return states with the hand on a grid of its box and of the boxes of ``hard``."""
    hard = TASKS["hard"]
    hands = np.concatenate(
        [grid(HAND_BOX), grid(hard.start_hand, 3, 3), grid(hard.goal_hand, 3, 3)]
    )
    pucks = np.where(hands[:, :1] > 0, (-0.1, 0.6), (0.1, 0.6))
    return np.concatenate([hands, pucks], axis=1)


def env_at(states):
    """Return an environment whose copies start in these states, with a goal far from each."""
    states = np.atleast_2d(states)
    env = make_vec("push-state", len(states))
    goals = np.where(states[:, :1] > 0, (-0.2, 0.5, -0.1, 0.6), (0.2, 0.7, 0.1, 0.6))
    env.reset(seed=0, options={"start": states, "goal": goals})
    return env


def idle(env, steps=1):
    for _ in range(steps):
        observations = env.step(np.zeros((env.num_envs, 2)))[0]
    return observations["observation"]


def keep_going(env):
    """Let ended episodes go on, for tests of the physics alone."""
    env._ended[:] = False
    env._elapsed[:] = 0


def test_hand_stands_where_it_was_asked_to():
    states = hands_and_pucks()
    env = env_at(states)
    for steps in (0, 1, 5):
        observed = idle(env, steps) if steps else env._states()
        errors = np.linalg.norm(observed[:, :2] - states[:, :2], axis=1)
        assert errors.max() < 0.003
    for copy in range(env.num_envs):
        hand = env.batch.get_data(copy)
        mujoco.mj_kinematics(env.model, hand)
        body = hand.body("left-finger")
        assert np.linalg.norm(body.xpos - (*states[copy, :2], 0.06)) < 0.003
        assert np.degrees(np.arccos(min(1.0, -body.xmat[6]))) < 1


def test_arm_is_placed_exactly_within_its_limits():
    model = push_model()
    arm, data = Arm(model), mujoco.MjData(model)
    for position in hands_and_pucks()[:, :2]:
        angles = arm.angles(position)
        data.qpos[arm.addresses] = angles
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.xpos[arm.hand], (*position, 0.06), atol=1e-8)
        np.testing.assert_allclose(data.xmat[arm.hand].reshape(3, 3), HAND_ROTATION, atol=1e-8)
        for angle, link in zip(angles, LINKS, strict=True):
            assert link.joint_range[0] <= angle <= link.joint_range[1], link.name
    with pytest.raises(ConfigurationError, match="reach"):
        arm.angles(np.array((0.0, 3.0)))


def test_arm_at_rest_stays_in_its_posture():
    """The seventh joint is where gravity leaves it: an arm that is not moved does not sink."""
    env = env_at(hands_and_pucks())
    before = env._qpos.copy()
    idle(env, 20)
    assert np.abs(env._qpos - before)[:, env._arm.addresses].max() < 0.01
    assert np.abs(env._qvel).max() < 0.01


def test_arm_settles_in_that_posture_from_another():
    """25 s as in the resets of the original end in the posture that is computed here."""
    model = push_model()
    arm, data = Arm(model), mujoco.MjData(model)
    data.qpos[arm.addresses] = (1.780, -0.684, -0.155, 2.307, 1.931, 0.128, 1.494)
    data.mocap_pos[0, :2] = (0.0, 0.6)
    data.qpos[env_at((0, 0.6, 0.1, 0.6))._puck] = (0.15, 0.6)
    mujoco.mj_step(model, data, 12_500)
    angles = data.qpos[arm.addresses]
    np.testing.assert_allclose(angles, arm.angles(np.array((0.0, 0.6))), atol=0.005)
    assert angles[RESTING_JOINT] == pytest.approx(LINKS[RESTING_JOINT].joint_range[1], abs=0.002)


def test_chain_is_that_of_the_original():
    """The stored angles of the original put its hand at about (-0.02, 0.50, 0.049)."""
    model = push_model()
    arm, data = Arm(model), mujoco.MjData(model)
    data.qpos[arm.addresses] = (1.780, -0.684, -0.155, 2.307, 1.931, 0.128, 1.494)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.xpos[arm.hand], (-0.02, 0.50, 0.049), atol=6e-4)
    assert (model.nq, model.nv, model.nu, model.nmocap) == (10, 10, 0, 1)
    moving = model.body_mass[1:].sum() - model.body("puck").mass[0]
    # Six links of the table, the first with the head, and a hand of 0.032 + 2 * 0.01 kg.
    links = 5.3213 + 1.5795 + 4.505 + 1.745 + 2.5097 + 1.1136 + 1.5625 + 0.3292
    assert moving == pytest.approx(links + 0.052)
    assert model.body("puck").mass[0] == 100.1
    assert (model.opt.timestep, model.opt.iterations) == (0.002, 50)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    for link in LINKS:
        assert model.joint(link.name).damping[0] == 10
        assert model.joint(link.name).armature[0] == 0.1


def test_weld_ties_the_hand_to_its_target_without_offset():
    model = push_model()
    anchor, position, quaternion, torque = np.split(model.eq_data[0, :11], (3, 6, 10))
    assert (anchor == 0).all()
    assert (position == 0).all()
    assert quaternion.tolist() == [1, 0, 0, 0]
    assert torque[0] == 1
    np.testing.assert_array_equal(model.eq_solref[0], (0.01, 1))


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 0.5)])
def test_hand_goes_where_the_action_says(direction):
    env = env_at((0, 0.6, 0.15, 0.66) if direction[0] <= 0 else (0, 0.6, -0.15, 0.66))
    seen = [env._states()[0, :2]]
    for _ in range(4):
        seen.append(env.step(np.array([direction]))[0]["observation"][0, :2])
    moved = np.diff(seen, axis=0)
    np.testing.assert_allclose(
        moved, np.tile(ACTION_SCALE * np.array(direction), (4, 1)), atol=3e-3
    )
    np.testing.assert_allclose(idle(env, 3)[0, :2], env._targets[0], atol=1e-3)
    np.testing.assert_allclose(
        env._targets[0], (0, 0.6) + 4 * ACTION_SCALE * np.array(direction), atol=1e-12
    )


def test_actions_and_the_target_are_bounded():
    env = env_at(((0.19, 0.69, -0.1, 0.6), (0.19, 0.69, -0.1, 0.6)))
    observed = env.step(np.array(((9.0, 9.0), (1.0, 1.0))))[0]["observation"]
    np.testing.assert_array_equal(observed[0], observed[1])
    np.testing.assert_array_equal(env._targets, np.tile(HAND_BOX.high, (2, 1)))
    for _ in range(5):
        observed = env.step(np.ones((2, 2)))[0]["observation"]
    np.testing.assert_allclose(observed[:, :2], np.tile(HAND_BOX.high, (2, 1)), atol=2e-3)


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_puck_follows_a_push_and_stays_inside(direction):
    ahead = np.array(direction, float)
    puck = np.array((0.0, 0.6)) - 0.01 * ahead
    env = env_at((*(puck - 0.06 * ahead), *puck))
    for _ in range(4):
        observed = env.step(ahead[None])[0]["observation"][0]
    moved = observed[2:] - puck
    assert 0.04 < moved @ ahead < 0.08
    assert np.abs(moved - (moved @ ahead) * ahead).max() < 0.01
    assert np.linalg.norm(observed[2:] - observed[:2]) > 0.04
    for _ in range(25):
        keep_going(env)
        observed = env.step(ahead[None])[0]["observation"][0]
        assert (
            (observed[2:] > PUCK_LIMITS[0] - 0.03) & (observed[2:] < PUCK_LIMITS[1] + 0.03)
        ).all()


def test_pucks_stay_on_the_table_and_inside_whatever_happens():
    env = make_vec("push-state", 8, task="near")
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    furthest = 0.0
    for step in range(80):
        if step % 10 == 0:
            actions = rng.choice((-1.0, 1.0), (8, 2))
        keep_going(env)
        observed = env.step(actions)[0]
        assert env.observation_space.contains(observed)
        assert (env._qpos[:, env._arm.addresses[2]] > 1).all()  # the elbow keeps to its side
        pucks = observed["observation"][:, 2:]
        beyond = np.maximum(PUCK_LIMITS[0] - pucks, pucks - PUCK_LIMITS[1])
        furthest = max(furthest, beyond.max())
    assert furthest < 0.04
    heights = env.batch.xpos[:, env.model.body("puck").id, 2]
    assert (np.abs(heights - PUCK_HEIGHT) < 0.1).all()


def test_no_puck_is_placed_in_a_wall():
    """A puck in a wall jumps within a step: one at x = -0.2 of the original by 28 mm."""
    pucks = grid(PUCK_BOX, 9, 7)
    hands = np.where(pucks[:, :1] > 0, (-0.1, 0.6), (0.1, 0.6))
    states = np.concatenate([hands, pucks], axis=1)
    env = env_at(states)
    np.testing.assert_allclose(idle(env), states, atol=5e-4)
    np.testing.assert_allclose(idle(env, 10), states, atol=5e-4)
    heights = env.batch.xpos[:, env.model.body("puck").id, 2]
    np.testing.assert_allclose(heights, PUCK_HEIGHT, atol=1e-4)


@pytest.mark.parametrize("task", TASKS)
def test_starts_and_goals_are_from_the_boxes_of_the_task(task):
    env = make_vec("push-state", 400, task=task)
    observations, info = env.reset(seed=0)
    assert not info["is_success"].any()
    boxes = TASKS[task]
    for key, hand, puck in (
        ("achieved_goal", boxes.start_hand, boxes.start_puck),
        ("desired_goal", boxes.goal_hand, boxes.goal_puck),
    ):
        states = observations[key].astype(np.float64)
        apart = np.linalg.norm(states[:, 2:] - states[:, :2], axis=1)
        assert (apart > CLEARANCE - 1e-6).all()
        for points, box in ((states[:, :2], hand), (states[:, 2:], puck)):
            assert box.grown(1e-6).contains(points).all()
            spread = np.ptp(points, axis=0) / (2 * box.half_x, 2 * box.half_y)
            assert (spread > 0.9).all()
    if task == "near":
        states = observations["achieved_goal"]
        assert (np.linalg.norm(states[:, 2:] - states[:, :2], axis=1) < 0.075 + 1e-6).all()


def test_hard_is_the_test_of_the_paper():
    hard = TASKS["hard"]
    corners = [(box.low, box.high) for box in (hard.start_hand, hard.start_puck, hard.goal_hand)]
    np.testing.assert_allclose(
        corners,
        [((0.15, 0.65), (0.2, 0.7)), ((-0.15, 0.55), (-0.1, 0.6)), ((-0.2, 0.5), (-0.15, 0.55))],
    )
    np.testing.assert_allclose(hard.goal_puck.low, (0.15, 0.65))
    assert hard.goal_puck.high == pytest.approx(PUCK_BOX.high)


def test_a_reset_leaves_nothing_of_the_episode_before():
    states = {"start": (0.1, 0.6, -0.05, 0.65), "goal": (-0.2, 0.5, 0.1, 0.6)}
    fresh, used = make_vec("push-state"), make_vec("push-state")
    used.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        keep_going(used)
        used.step(rng.uniform(-1, 1, (1, 2)))
    assert np.abs(used._qvel).max() > 0.01
    for env in (fresh, used):
        env.reset(seed=1, options=states)
    np.testing.assert_array_equal(used.batch.state, fresh.batch.state)
    assert (used._qvel == 0).all()


@pytest.mark.parametrize(
    "start",
    [
        (0.3, 0.6, 0.0, 0.6),
        (0.1, 0.6, 0.19, 0.6),
        (0.1, 0.6, 0.1, 0.62),
        (0.1, 0.6),
        (0.1, np.nan, 0.0, 0.6),
    ],
)
def test_a_start_that_cannot_be_is_refused(start):
    env = make_vec("push-state", 2)
    with pytest.raises(ConfigurationError, match="start"):
        env.reset(options={"start": start})


def towards(hand, place, puck):
    """Return the action that goes to a place, around the puck where it is in the way."""
    way = place - hand
    nearest = hand + np.clip(way @ (puck - hand) / (way @ way + 1e-12), 0, 1) * way
    if np.linalg.norm(nearest - puck) < 0.058:
        away = np.linalg.norm(hand - puck)
        outwards = (hand - puck) / away
        around = np.array((-outwards[1], outwards[0]))
        way = ACTION_SCALE * around * np.sign(around @ (place - puck)) + (0.065 - away) * outwards
    return way / max(ACTION_SCALE, np.abs(way).max())


def pusher(state, goal):
    """Return the action of a simple script: behind the puck, push it to its place, go home."""
    hand, puck = state[:2], state[2:]
    distance = np.linalg.norm(goal[2:] - puck)
    if distance < 0.03:
        return towards(hand, goal[:2], puck)
    ahead = (goal[2:] - puck) / distance
    across = np.array((-ahead[1], ahead[0]))
    if (hand - puck) @ ahead < -0.03 and abs((hand - puck) @ across) < 0.02:
        return ahead * min(1, 0.5 + distance / 0.02) - 35 * ((hand - puck) @ across) * across
    return towards(hand, puck - 0.06 * ahead, puck)


def test_the_test_task_can_be_solved_in_time():
    env = make_vec("push-state", 16, task="hard")
    observations, _ = env.reset(seed=0)
    solved_at = np.full(16, 1000)
    for step in range(1, env.goal_spec.max_episode_steps + 1):
        states = observations["observation"].astype(np.float64)
        goals = observations["desired_goal"].astype(np.float64)
        actions = np.stack([pusher(*pair) for pair in zip(states, goals, strict=True)])
        observations, _, terminated, _, info = env.step(actions)
        solved_at[terminated] = np.minimum(solved_at[terminated], step)
        np.testing.assert_array_equal(terminated, info["distance"] < np.float32(GOAL_THRESHOLD))
        env._ended[:] = False
        if (solved_at <= 100).all():
            break
    assert (solved_at <= 100).mean() >= 0.9
    assert np.median(solved_at) < 70
