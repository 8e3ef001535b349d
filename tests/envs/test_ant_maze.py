"""The ant against the figures of the original environment and the simulator's own state."""

import mujoco
import numpy as np
import pytest

from midway.envs.ant_maze import LEGS, ant_model, encode_rotation
from midway.envs.mazes import MAZES
from midway.envs.registry import make_vec

JOINTS = [f"{leg[0]}-{part}" for leg in LEGS for part in ("hip", "ankle")]


@pytest.fixture(scope="module")
def model():
    return ant_model(MAZES["u"])


def random_rotations(count):
    quaternions = np.random.default_rng(0).normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def test_rotation_is_encoded_as_in_the_original():
    """It takes the stored (w, x, y, z) for (x, y, z, w), and observes three angles of that."""
    quaternions = random_rotations(10_000)
    x, y, z, w = quaternions.T
    angles = (
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)),
    )
    original = np.stack([f(angle) for angle in angles for f in (np.cos, np.sin)], axis=1)
    np.testing.assert_allclose(encode_rotation(quaternions), original, atol=1e-7)
    upright = encode_rotation(np.array([[1.0, 0, 0, 0]]))
    np.testing.assert_allclose(upright, [[-1, 0, 1, 0, 1, 0]], atol=1e-12)


def test_observation_is_the_state_of_the_simulator():
    env = make_vec("ant-u", 3)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        observation = env.step(rng.uniform(-1, 1, (3, 8)))[0]["observation"]
    for copy in range(3):
        data = env.batch.get_data(copy)
        mujoco.mj_forward(env.batch.model, data)
        seen = observation[copy]
        torso = data.body("torso")
        np.testing.assert_allclose(seen[:3], torso.xpos, rtol=1e-6)
        rotation = torso.xmat.reshape(3, 3)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        pitch = -np.arcsin(rotation[2, 0])
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
        signs = np.array((-1, 1, 1, -1, 1, 1))
        turned = np.array([f(angle) for angle in (yaw, pitch, roll) for f in (np.cos, np.sin)])
        np.testing.assert_allclose(seen[3:9], signs * turned, atol=1e-6)
        for i, joint in enumerate(JOINTS):
            assert seen[9 + i] == np.float32(data.joint(joint).qpos[0])
            assert seen[23 + i] == np.float32(data.joint(joint).qvel[0])
        np.testing.assert_array_equal(seen[17:23], data.joint("root").qvel.astype(np.float32))


def test_linear_velocity_is_of_the_world_and_angular_of_the_body(model):
    data = mujoco.MjData(model)
    data.qpos[3:7] = random_rotations(1)[0]
    data.qvel[:6] = (0.3, -0.2, 0.1, 0.5, -0.4, 0.7)
    mujoco.mj_kinematics(model, data)
    before = data.body("torso").xpos.copy(), data.body("torso").xmat.reshape(3, 3).copy()
    dt = 1e-5
    mujoco.mj_integratePos(model, data.qpos, data.qvel, dt)
    mujoco.mj_kinematics(model, data)
    after = data.body("torso").xpos, data.body("torso").xmat.reshape(3, 3)
    np.testing.assert_allclose((after[0] - before[0]) / dt, data.qvel[:3], atol=1e-6)
    turn = before[1].T @ (after[1] - before[1]) / dt
    np.testing.assert_allclose((turn[2, 1], turn[0, 2], turn[1, 0]), data.qvel[3:6], atol=1e-4)


def test_actions_start_with_the_last_leg(model):
    data = mujoco.MjData(model)
    order = [*JOINTS[6:], *JOINTS[:6]]
    for action, joint in enumerate(order):
        data.ctrl[:] = 0
        data.ctrl[action] = 3.0  # beyond the range: clipped to 1
        mujoco.mj_forward(model, data)
        expected = np.zeros(model.nv)
        expected[model.joint(joint).dofadr[0]] = 10
        np.testing.assert_array_equal(data.qfrc_actuator, expected)


def test_body_is_that_of_the_original(model):
    assert (model.nq, model.nv, model.nu) == (15, 14, 8)
    assert (model.opt.timestep, model.opt.integrator) == (0.03, mujoco.mjtIntegrator.mjINT_RK4)
    assert (model.opt.cone, model.opt.solver) == (
        mujoco.mjtCone.mjCONE_PYRAMIDAL,
        mujoco.mjtSolver.mjSOL_NEWTON,
    )
    assert (model.opt.iterations, model.opt.gravity[2]) == (100, -9.81)
    assert model.body_mass.sum() == pytest.approx(0.9109, abs=5e-5)
    torso = model.body("torso").mass[0]
    assert torso == pytest.approx(0.3272 + 4 * 0.0392, abs=2e-4)
    for name, direction, axis, degrees in LEGS:
        assert model.body(f"{name}-thigh").mass[0] == pytest.approx(0.0392, abs=5e-5)
        assert model.body(f"{name}-shin").mass[0] == pytest.approx(0.0676, abs=5e-5)
        np.testing.assert_allclose(model.body(f"{name}-shin").pos[:2], 0.2 * np.array(direction))
        ankle = model.joint(f"{name}-ankle")
        np.testing.assert_allclose(np.rad2deg(ankle.range), degrees)
        np.testing.assert_allclose(ankle.axis[:2] * np.sqrt(2), axis)
        np.testing.assert_allclose(np.rad2deg(model.joint(f"{name}-hip").range), (-30, 30))
    assert (model.dof_armature == np.r_[np.zeros(6), np.ones(8)]).all()
    assert (model.dof_damping == np.r_[np.zeros(6), np.ones(8)]).all()
    assert (model.actuator_gear[:, 0] == 10).all()
    assert (model.actuator_ctrlrange == (-1, 1)).all()
    assert (model.geom_friction == (1, 0.5, 0.5)).all()
    assert (model.geom_margin == 0.01).all()
    assert (model.geom_condim == 3).all()


@pytest.mark.parametrize("name", MAZES)
def test_walls_of_the_model_are_those_of_the_maze(name):
    maze, model = MAZES[name], ant_model(MAZES[name])
    for kind, walls, contype in (("inner", maze.inner_walls, 3), ("outer", maze.outer_walls, 2)):
        for number, wall in enumerate(walls, start=1):
            geom = model.geom(f"{kind}-{number}")
            np.testing.assert_array_equal(geom.pos, (wall.x, wall.y, 0))
            np.testing.assert_array_equal(geom.size, (wall.half_x, wall.half_y, 1))
            assert (geom.contype, geom.conaffinity) == (contype, 3)
    floor = model.geom("floor")
    assert (floor.contype, floor.conaffinity) == (1, 1)
    np.testing.assert_array_equal(floor.size[:2], (50, 50))
    parts = [i for i in range(model.ngeom) if model.geom_bodyid[i] > 0]
    assert len(parts) == 13
    assert (model.geom_contype[parts] == 1).all()
    assert (model.geom_conaffinity[parts] == 0).all()


def test_starts_and_goals_are_the_canonical_pose_at_right_angles():
    env = make_vec("ant-pi", 64)
    observations, _ = env.reset(seed=0)
    for key in ("achieved_goal", "desired_goal"):
        states = observations[key]
        np.testing.assert_allclose(states[:, 2], 0.565)
        np.testing.assert_allclose(states[:, 5:9], np.tile([1, 0, 1, 0], (64, 1)), atol=1e-6)
        canonical = np.tile([0, 1, 0, -1, 0, -1, 0, 1], (64, 1))
        np.testing.assert_array_equal(states[:, 9:17], canonical)
        np.testing.assert_array_equal(states[:, 17:], 0)
        headings = {tuple(row) for row in np.round(states[:, 3:5]).astype(int).tolist()}
        assert headings == {(-1, 0), (1, 0), (0, 1), (0, -1)}
    turned = np.round(observations["achieved_goal"][:, 3:5] - observations["desired_goal"][:, 3:5])
    assert (turned != 0).any()
    np.testing.assert_allclose(np.linalg.norm(env.batch.qpos[:, 3:7], axis=1), 1, rtol=1e-12)


def test_start_pose_stands_on_four_feet():
    env = make_vec("ant-u", 1)
    env.reset(seed=0, options={"start": (-2.25, 0.0)})
    model, data = env.batch.model, env.batch.get_data(0)
    data.qpos[3:7] = (1, 0, 0, 0)
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    feet = []
    for name, *_ in LEGS:
        shin = data.geom(f"{name}-shin")
        ends = [
            shin.xpos + s * model.geom(f"{name}-shin").size[1] * shin.xmat[2::3] for s in (1, -1)
        ]
        feet.append(min(ends, key=lambda end: end[2]))
    offsets = np.array(feet) - data.body("torso").xpos
    assert np.array(feet)[:, 2] == pytest.approx(0.089, abs=1e-3)
    assert np.abs(offsets[:, :2]) + 0.08 == pytest.approx(0.70, abs=0.01)
    assert np.hypot(*offsets[:, :2].T) + 0.08 == pytest.approx(0.95, abs=0.01)


def test_it_sinks_slowly_without_torque_and_wanders_little_at_random():
    env = make_vec("ant-u", 4)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(40):
        observations = env.step(np.zeros((4, 8)))[0]
    assert observations["observation"][:, 2] == pytest.approx(0.52, abs=0.01)
    positions = [env.reset(seed=1)[0]["observation"][:, :2]]
    fastest = 0.0
    for _ in range(200):
        observation = env.step(rng.uniform(-1, 1, (4, 8)))[0]["observation"]
        positions.append(observation[:, :2])
        fastest = max(fastest, np.abs(observation[:, 17:]).max())
    travel = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    assert travel.mean() == pytest.approx(0.045, abs=0.01)
    assert np.linalg.norm(positions - positions[0], axis=-1).max() < 2.5
    assert 1 < fastest < 6


def test_parts_of_the_ant_touch_floor_and_walls_only():
    env = make_vec("ant-s", 4)
    rng = np.random.default_rng(0)
    env.reset(seed=0, options={"start": (-3.85, 0.0)})
    model = env.batch.model
    touched = set()
    for step in range(60):
        if step % 6 == 0:
            actions = rng.uniform(-1, 1, (4, 8))
        env.step(actions)
        for copy in range(4):
            data = env.batch.get_data(copy)
            mujoco.mj_forward(model, data)
            for bodies in model.geom_bodyid[data.contact.geom]:
                assert min(bodies) == 0
            touched |= set(data.contact.geom[:, 0].tolist())
    assert model.geom("floor").id in touched
