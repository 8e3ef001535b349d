"""Beyond the paper: targets, inputs and delayed steps, against NumPy by hand."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import beyond, ris, sac
from midway.networks import encoder, inputs
from midway.networks.encoder import StateEncoder
from midway.networks.mlp import normalised
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

TASK = DistanceTask(((0, 1),), 0.5)
METRES = StateEncoder((), 1.0)
SPEC = EnvSpec("states", (4,), "float32", (4,), 2, 50, True, None, TASK)
KEY = jax.random.key(0)

FAST = {
    "n_step": 3,
    "clip_targets": True,
    "unreached_goals": True,
    "num_critics": 1,
    "layer_norm": True,
    "goal_inputs": "relative",
    "policy_every": 2,
}


def batch(size: int = 8, **others: object) -> Batch:
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    drawn = Batch(
        observation=normal(size, 4),
        action=jnp.tanh(normal(size, 2)),
        reward=-jnp.ones(size),
        terminated=jnp.arange(size) == 0,
        next_observation=normal(size, 4),
        goal=normal(size, 4),
        subgoal_candidate=Subgoal(normal(size, 4), normal(size, 4)),
        steps=jnp.full(size, 3.0),
    )
    return drawn._replace(**others)


def test_targets_of_n_steps_by_hand():
    drawn = batch(4, steps=jnp.array([1.0, 2.0, 3.0, 3.0]), terminated=jnp.arange(4) == 3)
    target = beyond.n_step_target(drawn, jnp.full(4, -10.0), sac.Config(discount=0.5))
    # 1, 1.5 and 1.75 discounted steps, then 0.5^n of -10; nothing after the goal
    np.testing.assert_allclose(target, [-6, -4, -3, -1.75])


def test_targets_of_one_step_are_those_of_the_paper():
    drawn = batch(4, steps=None)
    value = jnp.array([-1.0, -2.0, -3.0, -4.0])
    found = beyond.n_step_target(drawn, value, sac.Config())
    np.testing.assert_array_equal(found, -1 + 0.99 * np.array([0, -2, -3, -4], np.float32))


def test_targets_are_clipped():
    config = sac.Config(discount=0.5, clip_targets=True)
    drawn = batch(2, steps=jnp.ones(2), terminated=jnp.zeros(2, bool))
    target = beyond.n_step_target(drawn, jnp.array([50.0, -50.0]), config)
    np.testing.assert_allclose(target, [0, -2])


def test_a_failed_step_is_worth_as_much_as_never_to_arrive():
    failed = jnp.array([True, True, False])
    drawn = batch(3, steps=jnp.array([1.0, 3.0, 3.0]), terminated=failed, failed=failed)
    value = jnp.full(3, -1.0)
    target = beyond.n_step_target(drawn, value, sac.Config(discount=0.5))
    np.testing.assert_allclose(target, [-2, -2, -1.875])
    half = beyond.n_step_target(drawn, value, sac.Config(discount=0.5, failure_cost=0.5))
    # two steps before the one that fails: -1 - 0.5 - 0.25
    np.testing.assert_allclose(half, [-1, -1.75, -1.875])
    dear = beyond.n_step_target(drawn._replace(steps=None), value, sac.Config(failure_cost=2.0))
    np.testing.assert_allclose(dear[:2], [-200, -200], rtol=1e-5)


def test_relative_inputs_by_hand():
    read = inputs.create(SPEC, "relative", METRES)
    state, goal = jnp.array([[1.0, 1.0, 7.0, 7.0]]), jnp.array([[4.0, 5.0, 9.0, 9.0]])
    seen, told = read(state, goal)
    np.testing.assert_array_equal(seen, state)
    wanted = [4, 5, 3, 4, 3 / 5.5, 4 / 5.5, np.log(5.25)]
    np.testing.assert_allclose(told[0], wanted, rtol=1e-5)
    assert told.shape[-1] == read.size(4)


def test_inputs_of_one_state_and_many_goals_are_broadcast():
    read = inputs.create(SPEC, "relative", METRES)
    _, told = read(jnp.zeros((3, 1, 4)), jnp.ones((3, 5, 4)))
    assert told.shape == (3, 5, 7)


def test_a_subgoal_of_coordinates_is_a_state_at_that_place():
    read = inputs.create(SPEC, "coordinates", METRES)
    state = jnp.array([[1.0, 2.0, 3.0, 4.0]])
    found = read.embed(state, jnp.array([[8.0, 9.0]]))
    np.testing.assert_array_equal(found, [[8, 9, 3, 4]])
    np.testing.assert_array_equal(read.pick(found), [[8, 9]])


def test_goals_that_are_entries_of_the_observation():
    task = DistanceTask(((0, 1),), 0.5)
    spec = EnvSpec("x", (4,), "float32", (2,), 2, 9, False, None, task, goal_coordinates=(3, 1))
    scaled = StateEncoder((0.0, 1.0, 0.0, 2.0), (1.0, 2.0, 1.0, 2.0), goal_coordinates=(3, 1))
    state, goal = jnp.array([[7.0, 3.0, 7.0, 4.0]]), jnp.array([[6.0, 9.0]])
    np.testing.assert_allclose(scaled(goal), [[2, 4]])
    np.testing.assert_allclose(scaled.states(scaled(goal)), goal)
    read = inputs.create(spec, "relative", scaled)
    seen, told = read(scaled(state), scaled(goal))
    np.testing.assert_array_equal(seen, [[7, 1, 7, 1]])
    # near: 0.5 in units of 2; the state is at (1, 1) of these coordinates, the goal at (2, 4)
    away = np.sqrt(10)
    np.testing.assert_allclose(
        told[0], [2, 4, 1, 3, 1 / (away + 0.25), 3 / (away + 0.25), np.log(away + 0.125)], rtol=1e-5
    )
    subgoal = encoder.as_subgoal(spec, read.embed(seen, jnp.array([[8.0, 9.0]])))
    np.testing.assert_array_equal(subgoal.observation, [[7, 9, 7, 8]])
    np.testing.assert_array_equal(subgoal.achieved_goal, [[8, 9]])
    assert encoder.subgoal_size(spec) == 4


def test_goals_that_are_no_observations_are_read_whole():
    pairs = replace(SPEC, observation_shape=(6,), goal_shape=(2,), goal_is_observation=False)
    assert inputs.create(pairs, "relative", METRES).size(2) == 2


def test_normalised_layers_have_mean_0_and_variance_1():
    x = normalised(jnp.asarray(np.random.default_rng(0).normal(3, 5, (7, 64)), jnp.float32))
    np.testing.assert_allclose(x.mean(-1), 0, atol=1e-5)
    np.testing.assert_allclose(x.var(-1), 1, rtol=1e-3)


@pytest.mark.parametrize("module", [ris, sac])
def test_delayed_policies_step_in_every_second_update(module):
    extra = {"subgoal_every": 2} if module is ris else {}
    config = module.Config(hidden=(8,), **FAST, **extra)
    state = module.create(config, SPEC, KEY)
    compiled = eqx.filter_jit(module.update)
    first, _ = compiled(state, batch(8), KEY)
    second, metrics = compiled(first, batch(8), KEY)

    def same(a: object, b: object) -> bool:
        return bool(eqx.tree_equal(eqx.filter(a, eqx.is_array), eqx.filter(b, eqx.is_array)))

    assert not same(first.policy, state.policy)
    assert same(second.policy, first.policy)
    assert not same(second.critic, first.critic)
    assert all(np.isfinite(float(value)) for value in metrics.values())


@pytest.mark.parametrize("agent", [ris, sac])
def test_learning_rates_of_each_network_halve_after_as_many_of_its_updates(agent):
    """The second step of critics and policies is half as long with N = 1."""
    config = agent.Config(hidden=(8,))
    first, _ = agent.update(agent.create(config, SPEC, KEY), batch(), KEY)
    decaying = replace(first, config=replace(config, halve_rates_after=1))
    keys = (KEY, KEY) if agent is ris else (KEY,)
    steps = {
        "critic": (agent.update_critic, batch().observation, batch(), KEY),
        "policy": (agent.update_policy, batch(), *keys),
    }
    if agent is ris:
        steps["subgoal_policy"] = (agent.update_subgoal_policy, batch())
    for name, (step, *given) in steps.items():

        def moved(state, name=name, step=step, given=given):
            after = step(state, *given)[0]
            before, after = (jax.tree.leaves(getattr(x, name)) for x in (state, after))
            return [new - old for old, new in zip(before, after, strict=True)]

        for whole, half in zip(moved(first), moved(decaying), strict=True):
            np.testing.assert_allclose(half, whole / 2, atol=1e-7)


def test_an_averaged_policy_follows_by_its_rate_and_acts_without_noise(pairs):
    config = replace(pairs.state.config, policy_average_rate=0.25)
    old = ris.create(config, pairs.spec, jax.random.key(1))
    policy = ris.create(config, pairs.spec, jax.random.key(2)).policy
    moved = ris.update_targets(replace(old, policy=policy))
    networks = map(jax.tree.leaves, (old.policy, policy, moved.average_policy))
    for before, online, after in zip(*networks, strict=True):
        np.testing.assert_allclose(after, 0.25 * online + 0.75 * before, rtol=1e-5, atol=1e-6)
    inputs = pairs.batch.observation, pairs.batch.goal, jax.random.key(3)
    alone = replace(moved, policy=moved.average_policy, average_policy=None)
    np.testing.assert_array_equal(ris.act(moved, *inputs, False), ris.act(alone, *inputs, False))
    noisy = replace(moved, average_policy=None)
    np.testing.assert_array_equal(ris.act(moved, *inputs, True), ris.act(noisy, *inputs, True))
    assert (ris.act(moved, *inputs, False) != ris.act(noisy, *inputs, False)).any()


def test_without_a_rate_there_is_no_averaged_policy(pairs):
    assert pairs.state.config.policy_average_rate == 0
    assert pairs.state.average_policy is None
    assert ris.update_targets(pairs.state).average_policy is None
