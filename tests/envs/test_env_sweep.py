"""One sweep over every environment of the registry: the contract that the floors above rely on."""

import io

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from drawing_here import needs_renderer
from midway.envs.registry import ENVIRONMENTS, make_vec
from midway.envs.single import SingleGoalEnv
from midway.errors import ConfigurationError

NAMES = list(ENVIRONMENTS)
COPIES = 4

every_environment = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=needs_renderer if n == "push" else ()) for n in NAMES]
)
every_maze = pytest.mark.parametrize("name", [n for n in NAMES if not n.startswith("push")])


def random_actions(env, rng):
    return rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)


def assert_same(first, second):
    assert first.keys() == second.keys()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key], err_msg=key)
        assert np.asarray(first[key]).dtype == np.asarray(second[key]).dtype, key


def rollout(env, seed, steps, reset_every=0):
    """Return all that an environment gives, with every other copy reset now and then."""
    rng = np.random.default_rng(seed)
    records = [env.reset(seed=seed)[0]]
    odd = np.arange(env.num_envs) % 2 == 1
    for step in range(1, steps + 1):
        observations, reward, terminated, truncated, _ = env.step(random_actions(env, rng))
        records.append(
            observations | {"reward": reward, "terminated": terminated, "truncated": truncated}
        )
        mask = terminated | truncated
        if reset_every and step % reset_every == 0:
            mask |= odd
        if mask.any():
            records.append(env.reset(options={"reset_mask": mask})[0])
    return {
        f"{i}/{key}": value for i, record in enumerate(records) for key, value in record.items()
    }


@every_environment
def test_observations_and_rewards_keep_the_contract(name):
    env = make_vec(name, COPIES)
    spec = env.goal_spec
    rng = np.random.default_rng(0)
    assert spec.name == name
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert env.single_action_space.shape == (spec.action_dim,)
    previous, _ = env.reset(seed=0)
    for _ in range(25):
        observations, reward, terminated, truncated, info = env.step(random_actions(env, rng))
        assert env.observation_space.contains(observations)
        assert observations["observation"].shape == (COPIES, *spec.observation_shape)
        assert observations["observation"].dtype == spec.observation_dtype
        assert observations["desired_goal"].shape == (COPIES, *spec.goal_shape)
        assert all(np.isfinite(values).all() for values in observations.values())
        arrays = list(observations.values())
        for i, array in enumerate(arrays):
            assert not any(np.shares_memory(array, other) for other in arrays[i + 1 :])
            assert not any(np.shares_memory(array, other) for other in previous.values())
        again = spec.task(*env.success_pair(observations))
        np.testing.assert_array_equal(reward, again[0])
        np.testing.assert_array_equal(terminated, again[1])
        assert (reward.dtype, terminated.dtype, truncated.dtype) == (np.float32, bool, bool)
        assert (reward == -1).all()
        np.testing.assert_array_equal(info["is_success"], terminated)
        np.testing.assert_array_equal(info["distance"] < spec.task.threshold, terminated)
        previous = observations
        if terminated.any():
            previous, _ = env.reset(options={"reset_mask": terminated})
    if spec.goal_is_observation:
        np.testing.assert_array_equal(observations["observation"], observations["achieved_goal"])


@every_environment
def test_a_seed_determines_everything(name):
    first = rollout(make_vec(name, COPIES), seed=3, steps=12, reset_every=5)
    assert_same(first, rollout(make_vec(name, COPIES), seed=3, steps=12, reset_every=5))
    other = make_vec(name, COPIES).reset(seed=30)[0]
    assert not np.array_equal(first["0/observation"], other["observation"])


@every_environment
def test_batch_equals_batches_of_one_at_any_number_of_threads(name):
    batch = make_vec(name, COPIES, num_threads=2)
    singles = [make_vec(name, 1, num_threads=1) for _ in range(COPIES)]
    rng = np.random.default_rng(0)
    together, _ = batch.reset(seed=7)
    apart = [single.reset(seed=7 + i)[0] for i, single in enumerate(singles)]
    for step in range(8):
        for i in range(COPIES):
            assert_same(
                {k: v[i] for k, v in together.items()}, {k: v[0] for k, v in apart[i].items()}
            )
        actions = random_actions(batch, rng)
        together = batch.step(actions)[0]
        apart = [single.step(actions[i : i + 1])[0] for i, single in enumerate(singles)]
        if step % 3 == 2:
            mask = np.array([True, False, False, True])
            together, _ = batch.reset(options={"reset_mask": mask})
            apart = [
                single.reset()[0] if mask[i] else seen
                for i, (single, seen) in enumerate(zip(singles, apart, strict=True))
            ]
    states = np.concatenate([single.batch.state for single in singles])
    np.testing.assert_array_equal(batch.batch.state, states)


@every_environment
def test_masks_and_seeds_act_as_in_gymnasium(name):
    ours = make_vec(name, COPIES)
    theirs = SyncVectorEnv(
        [lambda: SingleGoalEnv(name)] * COPIES, autoreset_mode=AutoresetMode.DISABLED
    )
    rng = np.random.default_rng(1)
    resets = [{"task": "hard"}, {"reset_mask": np.array([False, True, True, False])}, {}]
    for seed, options in zip((5, 11, [1, None, 3, None]), resets, strict=True):
        expected, expected_info = theirs.reset(seed=seed, options=dict(options))
        given, given_info = ours.reset(seed=seed, options=options)
        assert_same(given, expected)
        was_reset = expected_info["_distance"]
        np.testing.assert_array_equal(given_info["_distance"], was_reset)
        # Of copies that go on we tell the values too, where Gymnasium gives zeros.
        assert_same(*({k: v[was_reset] for k, v in i.items()} for i in (given_info, expected_info)))
        for _ in range(2):
            actions = random_actions(ours, rng)
            expected, given = theirs.step(actions), ours.step(actions)
            assert_same(given[0], expected[0])
            for mine, other in zip(given[1:4], expected[1:4], strict=True):
                np.testing.assert_array_equal(mine, other)
            assert_same(given[4], expected[4])
    theirs.close()


@every_environment
def test_a_mask_touches_only_its_copies(name):
    env = make_vec(name, COPIES)
    rng = np.random.default_rng(2)
    env.reset(seed=0)
    observations = env.step(random_actions(env, rng))[0]
    before = env.state_dict()
    mask = np.array([False, True, False, False])
    options = {"reset_mask": mask}
    fresh, _ = env.reset(options=options)
    assert options == {"reset_mask": mask}
    after = env.state_dict()
    for key in ("elapsed", "ended", "generators", "simulation", "desired_goal"):
        np.testing.assert_array_equal(after[key][~mask], before[key][~mask], err_msg=key)
    for key, values in fresh.items():
        np.testing.assert_array_equal(values[~mask], observations[key][~mask], err_msg=key)
    assert not np.array_equal(fresh["observation"][mask], observations["observation"][mask])
    np.testing.assert_array_equal(after["elapsed"], [1, 0, 1, 1])


@every_environment
def test_state_dict_continues_bit_for_bit(name):
    env = make_vec(name, COPIES)
    rollout(env, seed=1, steps=9, reset_every=4)
    file = io.BytesIO()
    np.savez(file, **env.state_dict())
    file.seek(0)
    copy = make_vec(name, COPIES, task="hard")
    copy.reset(seed=99)
    with np.load(file, allow_pickle=False) as state:
        copy.load_state_dict(dict(state))
    assert copy.task == env.task == "uniform"
    assert_same(copy.state_dict(), env.state_dict())
    rng = np.random.default_rng(3)
    for _ in range(6):
        actions = random_actions(env, rng)
        assert_same(copy.step(actions)[0], env.step(actions)[0])
    assert_same(copy.reset()[0], env.reset()[0])


@every_environment
def test_terminated_and_truncated_are_told_apart(name):
    env = make_vec(name, COPIES)
    limit = env.goal_spec.max_episode_steps
    observations, _ = env.reset(seed=0)
    state = env.state_dict()
    state["elapsed"][:] = [0, limit - 1, 0, limit - 1]
    for key in [key for key in state if key.startswith("desired_")]:
        state[key][2:] = observations[key.replace("desired", "achieved")][2:]
    env.load_state_dict(state)
    still = np.zeros(env.action_space.shape, np.float32)
    _, _, terminated, truncated, _ = env.step(still)
    np.testing.assert_array_equal(terminated, [False, False, True, True])
    np.testing.assert_array_equal(truncated, [False, True, False, True])
    with pytest.raises(ResetNeeded, match=r"\[1, 2, 3\]"):
        env.step(still)
    env.reset(options={"reset_mask": terminated | truncated})
    env.step(still)


@every_environment
def test_no_start_is_at_its_goal(name):
    env = make_vec(name, 64)
    for task in env.tasks:
        for seed in (None, 0):
            info = env.reset(seed=seed, options={"task": task})[1]
            assert not info["is_success"].any()


@every_maze
def test_no_start_or_goal_is_in_a_wall(name):
    env = make_vec(name, 64)
    for task in ("uniform", env.tasks[-1]):
        for seed in (None, 0):
            observations, _ = env.reset(seed=seed, options={"task": task})
            for key in ("achieved_goal", "desired_goal"):
                positions = observations[key][:, :2].astype(np.float64)
                assert env.maze.free(positions, 0.75 - 1e-5).all()


@every_maze
def test_no_visited_point_is_in_a_wall(name):
    env = make_vec(name, 8)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    actions = random_actions(env, rng)
    for step in range(60):
        if step % 12 == 0:
            actions = random_actions(env, rng)
        observations, _, terminated, _, _ = env.step(actions)
        assert env.maze.free(observations["observation"][:, :2].astype(np.float64), 0.1).all()
        if terminated.any():
            env.reset(options={"reset_mask": terminated})


@every_environment
@pytest.mark.filterwarnings("ignore:.*A Box observation space.*infinity:UserWarning")
def test_gymnasium_makes_and_checks_it(name):
    gym_id = ENVIRONMENTS[name].gym_id
    env = gymnasium.make(gym_id, task="hard")
    # A window needs a display: test_window.py has one, and compares it with what rgb_array shows.
    check_env(env.unwrapped, skip_render_check=True)
    observations, _ = env.reset(seed=0)
    observations, reward, terminated, truncated, info = env.step(env.action_space.sample())
    pair = env.unwrapped.vector.success_pair(observations)
    assert env.unwrapped.compute_reward(*pair, info) == reward
    assert env.unwrapped.compute_terminated(*pair, info) == terminated
    assert env.unwrapped.compute_truncated(*pair, info) == truncated
    many = tuple(np.stack([goal, goal]) for goal in pair)
    np.testing.assert_array_equal(env.unwrapped.compute_reward(*many, info), [-1, -1])
    env.close()
    vector = gymnasium.make_vec(gym_id, num_envs=3, task="hard")
    assert vector.task == "hard"
    assert vector.observation_space.contains(vector.reset(seed=0)[0])
    vector.close()


@every_environment
def test_wrong_input_is_named(name):
    env = make_vec(name, 2)
    still = np.zeros(env.action_space.shape, np.float32)
    with pytest.raises(ResetNeeded):
        env.step(still)
    with pytest.raises(ConfigurationError, match=r"'far'.*uniform, hard"):
        env.reset(options={"task": "far"})
    with pytest.raises(ConfigurationError, match=r"'mask'.*reset_mask"):
        env.reset(options={"mask": np.ones(2, bool)})
    with pytest.raises(TypeError, match="bool"):
        env.reset(options={"reset_mask": [True, False]})
    with pytest.raises(ValueError, match="shape"):
        env.reset(options={"reset_mask": np.ones(3, bool)})
    with pytest.raises(ValueError, match="at least one"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    with pytest.raises(ValueError, match="3 seeds for 2"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions"):
        env.step(still[:1])
    with pytest.raises(ValueError, match="finite"):
        env.step(still * np.nan)
    with pytest.raises(ConfigurationError, match="elapsed"):
        env.load_state_dict(make_vec(name, 3).state_dict())
    with pytest.raises(ConfigurationError, match="num_envs 0"):
        make_vec(name, 0)
    with pytest.raises(ConfigurationError, match=r"'far'.*hard"):
        make_vec(name, task="far")


def test_an_unknown_name_is_named():
    with pytest.raises(ConfigurationError, match=r"'ant-x'.*point-u.*ant-omega"):
        make_vec("ant-x")
