"""Temporal difference models: targets by hand, pure and delayed updates, time, a toy task."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import tdm
from midway.types import Batch, ConfigurationError, DistanceTask, EnvSpec, Outcome, Subgoal

KEY = jax.random.key(7)
TASK = DistanceTask(((0, 1),), 0.5)
IMAGE = (84, 84, 3)
SPECS = {
    "states": EnvSpec("states", (4,), "float32", (4,), 2, 50, True, None, TASK),
    "pairs": EnvSpec("pairs", (6,), "float32", (2,), 2, 50, False, None, TASK),
}
SMALL = tdm.Config(hidden=(16, 16), max_steps_left=5, critic_learning_rate=0.01)


def draw_batch(spec: EnvSpec, size: int = 32) -> Batch:
    keys = iter(jax.random.split(jax.random.key(1), 5))
    observation = jax.random.normal(next(keys), (size, *spec.observation_shape))
    goal = jax.random.normal(next(keys), (size, *spec.goal_shape))
    following = observation + 0.3 * jax.random.normal(next(keys), observation.shape)
    achieved = following if spec.goal_is_observation else following[:, : spec.goal_shape[0]]
    reward, terminated = spec.task(achieved, goal)
    return Batch(
        observation=observation,
        action=jax.random.uniform(next(keys), (size, spec.action_dim), minval=-1.0),
        reward=reward,
        terminated=terminated,
        next_observation=following,
        goal=goal,
        subgoal_candidate=Subgoal(observation, goal),
        outcome=None if spec.goal_is_observation else Outcome(achieved, goal),
    )


@functools.cache
def compiled():
    return eqx.filter_jit(tdm.update)


@pytest.fixture(params=SPECS)
def spec(request: pytest.FixtureRequest) -> EnvSpec:
    return SPECS[request.param]


def arrays(tree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def equal(first, second) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(arrays(first), arrays(second), strict=True))


def changed(before, after) -> set[str]:
    fields = set(vars(before)) - {"config", "spec", "encoder", "encoder_optimizer"}
    return {name for name in fields if not equal(getattr(before, name), getattr(after, name))}


# --- rewards and targets --------------------------------------------------------------------------


def test_rewards_are_scaled_differences_of_the_first_numbers():
    batch = draw_batch(SPECS["states"])
    reward = tdm.reward_vector(replace(SMALL, num_rewards=2), batch)
    expected = -10 * np.abs(batch.next_observation - batch.goal)[:, :2]
    np.testing.assert_allclose(reward, expected, rtol=1e-6)
    assert tdm.reward_vector(SMALL, batch).shape == (32, 4)


def test_rewards_are_of_the_outcome_where_the_goal_is_no_observation():
    batch = draw_batch(SPECS["pairs"])
    reward = tdm.reward_vector(replace(SMALL, reward_scale=1.0), batch)
    np.testing.assert_allclose(reward, -np.abs(batch.next_observation[:, :2] - batch.goal))


def test_the_target_is_the_reward_only_when_no_step_is_left(spec):
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    reward = tdm.reward_vector(SMALL, batch)
    steps_left = jnp.arange(32.0)[:, None] % 3
    noise = jnp.zeros(batch.action.shape)
    target = tdm.critic_target(state, batch, reward, steps_left, noise)
    now = np.asarray(steps_left)[:, 0] == 0
    np.testing.assert_array_equal(target[now], reward[now])
    action = jnp.tanh(state.target_policy(batch.next_observation, batch.goal, steps_left - 1))
    inputs = batch.next_observation, action, batch.goal, steps_left - 1
    first, second = (network(*inputs) for network in state.target_critic)
    np.testing.assert_allclose(target[~now], np.minimum(first, second)[~now], rtol=1e-5)
    # Element-wise: neither network has all of the smaller numbers.
    assert (first < second).any()
    assert (first > second).any()


def test_target_actions_have_clipped_noise_and_are_not_clipped_again():
    spec = SPECS["states"]
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    steps_left = jnp.ones((32, 1))
    # The target policy's actions are about 0: noise of 2.5 deviations is at its bound of 0.5.
    targets = [
        tdm.critic_target(state, batch, jnp.zeros((32, 4)), steps_left, jnp.full((32, 2), size))
        for size in (2.0, 2.5, 9.0)
    ]
    assert not jnp.allclose(targets[0], targets[1])
    np.testing.assert_array_equal(targets[1], targets[2])


def test_terminated_and_scalar_reward_are_not_used(spec):
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    other = batch._replace(reward=batch.reward * 3, terminated=~batch.terminated)
    assert equal(compiled()(state, batch, KEY), compiled()(state, other, KEY))


def test_losses_by_hand():
    spec = SPECS["states"]
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    steps_left, target = jnp.ones((32, 1)), jax.random.normal(KEY, (32, 4))
    loss, _ = tdm.critic_loss(
        (state.critic, state.encoder), batch.observation, batch, steps_left, target
    )
    inputs = batch.observation, batch.action, batch.goal, steps_left
    by_hand = sum(np.mean((np.asarray(n(*inputs)) - target) ** 2) for n in state.critic)
    np.testing.assert_allclose(loss, by_hand, rtol=1e-5)

    strong = eqx.tree_at(lambda p: p.layers[-1].bias, state.policy, jnp.array([25.0, -21.0]))
    loss, metrics = tdm.policy_loss(strong, state, batch, steps_left)
    assert metrics["policy/saturation"] == pytest.approx(3, abs=0.1)  # mean of 5 and 1
    pre_tanh = strong(batch.observation, batch.goal, steps_left)
    q = state.critic[0](batch.observation, jnp.tanh(pre_tanh), batch.goal, steps_left)
    np.testing.assert_allclose(loss, -q.mean() + metrics["policy/saturation"], rtol=1e-5)


def test_value_is_minus_the_predicted_distance():
    state = tdm.create(SMALL, SPECS["states"], KEY)
    bias = jnp.array([-30.0, -40.0, 0.0, 0.0])
    fixed = (state.critic[0].layers[-1].weight * 0, bias)
    state = eqx.tree_at(
        lambda s: (s.critic[0].layers[-1].weight, s.critic[0].layers[-1].bias), state, fixed
    )
    value = tdm.value(state, jnp.zeros((3, 4)), jnp.zeros((3, 4)), jnp.zeros((3, 1)))
    np.testing.assert_allclose(value, [-5, -5, -5], rtol=1e-6)  # |(30, 40)| / reward scale 10


# --- update ---------------------------------------------------------------------------------------


def test_updates_are_pure(spec):
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    copies = arrays((state, batch))
    first, second = (compiled()(state, batch, KEY) for _ in range(2))
    assert equal(first, second)
    assert all(np.array_equal(a, b) for a, b in zip(copies, arrays((state, batch)), strict=True))
    other = compiled()(state, batch, jax.random.key(8))
    assert not equal(first, other)  # other steps_left, other noise


def test_policy_and_target_networks_move_on_every_second_update(spec):
    state, batch = tdm.create(SMALL, spec, KEY), draw_batch(spec)
    always = {"critic", "critic_optimizer", "updates"}
    delayed = {"policy", "policy_optimizer", "target_policy", "target_critic"}
    for number in range(4):
        after, metrics = compiled()(state, batch, jax.random.key(number))
        moved = changed(state, after)
        assert moved == always | (delayed if number % 2 == 0 else set())
        assert (metrics["policy/loss"] != 0) == (number % 2 == 0)
        assert int(after.updates) == number + 1
        state = after


def test_target_networks_move_by_their_rate():
    spec = SPECS["states"]
    config = replace(SMALL, target_update_rate=0.25)
    state, batch = tdm.create(config, spec, KEY), draw_batch(spec)
    after, _ = compiled()(state, batch, KEY)
    for online, copy in (("critic", "target_critic"), ("policy", "target_policy")):
        old, new, moved = (
            arrays(getattr(*p)) for p in ((state, copy), (after, online), (after, copy))
        )
        for o, n, m in zip(old, new, moved, strict=True):
            np.testing.assert_allclose(m, 0.25 * n + 0.75 * o, rtol=1e-5, atol=1e-7)


def test_target_networks_have_arrays_of_their_own_and_outputs_start_small():
    state = tdm.create(SMALL, SPECS["states"], KEY)
    pairs = ((state.critic, state.target_critic), (state.policy, state.target_policy))
    for online, copy in pairs:
        assert equal(online, copy)
        pointers = [
            {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}
            for tree in (online, copy)
        ]
        assert not pointers[0] & pointers[1]
    for network in (*state.critic, state.policy):
        output = network.layers[-1]
        assert 2e-3 < jnp.abs(output.weight).max() <= 3e-3
        assert jnp.abs(output.bias).max() <= 3e-3


def test_steps_left_are_uniform_with_both_ends():
    steps_left = tdm.draw_steps_left(SMALL, 6_000, KEY)
    values, counts = np.unique(steps_left, return_counts=True)
    assert values.tolist() == [0, 1, 2, 3, 4, 5]
    assert counts.min() > 850


def test_image_goals_need_a_state():
    spec = EnvSpec("images", IMAGE, "uint8", IMAGE, 2, 50, True, None, TASK)
    with pytest.raises(ConfigurationError, match="images: rewards of tdm"):
        tdm.create(SMALL, spec, KEY)


def test_defaults_are_those_of_the_ant():
    config = tdm.Config()
    assert (config.hidden, config.max_steps_left, config.reward_scale) == ((400, 300), 50, 10)
    assert (config.target_update_rate, config.policy_delay) == (0.005, 2)
    assert (config.target_noise, config.target_noise_bound) == (0.2, 0.5)
    assert (config.exploration_reversion, config.exploration_noise) == (0.15, 0.3)
    assert config.critic_learning_rate == config.policy_learning_rate == 1e-3


# --- time and exploration -------------------------------------------------------------------------


def test_time_counts_down_and_starts_again(monkeypatch):
    spec, seen = SPECS["states"], []
    state = tdm.create(SMALL, spec, KEY)
    memory = tdm.begin(SMALL, spec, 3)
    memory = memory._replace(steps_left=jnp.array([5, 2, 0]))
    zeros = jnp.zeros((3, 4))
    for _ in range(4):
        seen.append(memory.steps_left.tolist())
        _, memory = tdm.act_on(state, memory, zeros, zeros, KEY, False)
    assert seen == [[5, 2, 0], [4, 1, 5], [3, 0, 4], [2, 5, 3]]


def test_steps_left_reach_the_policy():
    spec = SPECS["states"]
    state = tdm.create(SMALL, spec, KEY)
    strong = jax.tree.map(lambda x: 100 * x, state.policy.layers[-1])
    state = eqx.tree_at(lambda s: s.policy.layers[-1], state, strong)
    observation = jnp.ones((2, 4))
    memory = tdm.begin(SMALL, spec, 2)._replace(steps_left=jnp.array([0, 5]))
    actions, _ = tdm.act_on(state, memory, observation, observation, KEY, False)
    assert not jnp.allclose(actions[0], actions[1])
    first = tdm.act(state, observation, observation, KEY, False)
    np.testing.assert_allclose(first[0], actions[1], rtol=1e-6)


def test_noise_is_an_ornstein_uhlenbeck_process_that_is_clipped():
    spec = SPECS["states"]
    state = tdm.create(SMALL, spec, KEY)
    memory = tdm.begin(SMALL, spec, 500)
    zeros, previous = jnp.zeros((500, 4)), None
    for number in range(40):
        previous = memory.noise
        key = jax.random.key(number)
        actions, memory = tdm.act_on(state, memory, zeros, zeros, key, True)
        drawn = 0.3 * jax.random.normal(key, (500, 2))
        np.testing.assert_allclose(memory.noise, 0.85 * previous + drawn, rtol=1e-5, atol=1e-6)
        assert jnp.abs(actions).max() <= 1
    stationary = 0.3 / np.sqrt(1 - 0.85**2)
    assert memory.noise.std() == pytest.approx(stationary, rel=0.1)


# --- a task with a known answer -------------------------------------------------------------------

REACH = 0.5
"""How far the point of the toy task moves in one step along each axis."""


def toy_batch(key: jax.Array, size: int = 256) -> Batch:
    """Return steps of a point in [-2, 2]², with goals that no policy chose."""
    start_key, action_key, goal_key = jax.random.split(key, 3)
    observation = jax.random.uniform(start_key, (size, 2), minval=-2.0, maxval=2.0)
    action = jax.random.uniform(action_key, (size, 2), minval=-1.0)
    following = observation + REACH * action
    goal = jax.random.uniform(goal_key, (size, 2), minval=-2.0, maxval=2.0)
    reward, terminated = TASK(following, goal)
    candidate = Subgoal(observation, observation)
    return Batch(observation, action, reward, terminated, following, goal, candidate)


def test_a_point_that_has_four_steps_is_brought_as_near_as_it_can_come():
    spec = EnvSpec("toy", (2,), "float32", (2,), 2, 4, True, None, TASK)
    config = tdm.Config(
        hidden=(64, 64),
        max_steps_left=3,
        reward_scale=1.0,
        target_update_rate=0.05,
        target_noise=0.05,  # the usual noise makes the best value smaller by 0.1 m
    )

    @jax.jit
    def train(state, key):
        def one(state, key):
            batch_key, update_key = jax.random.split(key)
            return tdm.update(state, toy_batch(batch_key), update_key)[0], None

        return jax.lax.scan(one, state, jax.random.split(key, 3_000))[0]

    state = train(tdm.create(config, spec, KEY), jax.random.key(1))
    batch = toy_batch(jax.random.key(2))
    start, goal = batch.observation, batch.goal
    for steps in (1, 2, 4):
        # On each axis the distance shrinks by REACH a step, down to nothing.
        best = np.maximum(np.abs(goal - start) - steps * REACH, 0)
        left = jnp.full((len(goal), 1), steps - 1.0)
        value = tdm.value(state, start, goal, left)
        error = np.abs(np.linalg.norm(best, axis=1) + value)
        assert error.mean() < 0.15, steps

        position, memory = start, tdm.begin(config, spec, len(goal))
        memory = memory._replace(steps_left=jnp.full(len(goal), steps - 1))
        for _ in range(steps):
            action, memory = tdm.act_on(state, memory, position, goal, KEY, False)
            position = position + REACH * action
        distance = np.linalg.norm(position - goal, axis=1)
        assert (distance - np.linalg.norm(best, axis=1)).mean() < 0.15, steps
