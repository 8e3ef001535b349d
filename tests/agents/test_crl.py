"""CRL: InfoNCE by hand, its goals, and a toy problem that it solves."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import crl, registry
from midway.replay.relabel import steps_ahead
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

SPEC = EnvSpec("line", (1,), "float32", (1,), 1, 50, True, None, DistanceTask(((0,),), 0.1))
KEY = jax.random.key(0)


def test_infonce_by_hand():
    logits = np.array([[1.0, 2.0], [3.0, 5.0]])
    rows = np.log(np.exp(logits).sum(1)) - np.diag(logits)
    columns = np.log(np.exp(logits).sum(0)) - np.diag(logits)
    found = crl.infonce(jnp.asarray(logits, jnp.float32))
    assert float(found) == pytest.approx(rows.mean() + columns.mean(), rel=1e-5)


def test_logits_are_minus_distances_of_all_pairs():
    found = crl.distance_logit(jnp.array([[0.0, 0.0], [3.0, 0.0]])[:, None], jnp.zeros((1, 1, 2)))
    np.testing.assert_allclose(found[:, 0], [0, -3], atol=2e-3)


def test_a_share_of_the_policys_goals_is_that_of_others():
    goals = jnp.arange(4.0)[:, None]
    np.testing.assert_array_equal(crl.policy_goals(goals, 0.5)[:, 0], [3, 0, 2, 3])
    np.testing.assert_array_equal(crl.policy_goals(goals, 0.0), goals)


def test_future_goals_are_drawn_by_the_discounted_distribution():
    left = jnp.full(200_000, 4)
    found = np.bincount(steps_ahead(left, 0.5, KEY), minlength=5)[1:] / len(left)
    wanted = 0.5 ** np.arange(1, 5)
    np.testing.assert_allclose(found, wanted / wanted.sum(), atol=5e-3)


@pytest.mark.parametrize("discount", [1.0, 0.99, 0.5])
def test_future_goals_lie_within_the_episode(discount):
    left = jnp.arange(1, 300)
    found = steps_ahead(left, discount, KEY)
    assert (found >= 1).all()
    assert (found <= left).all()


def test_it_learns_to_walk_along_a_line():
    """The next state is the state plus the action, and that is the goal: walk towards goals."""
    rates = {f"{name}_learning_rate": 3e-3 for name in ("critic", "policy", "entropy")}
    config = crl.Config(hidden=(32, 32), features=8, random_goals=0.0, target_entropy=-2.0, **rates)
    state = crl.create(config, SPEC, KEY)

    def draw(key):
        keys = jax.random.split(key)
        observation = jax.random.uniform(keys[0], (64, 1), minval=-1, maxval=1)
        action = jax.random.uniform(keys[1], (64, 1), minval=-1, maxval=1)
        goal = observation + action
        none = jnp.zeros(64)
        return Batch(observation, action, none, none > 0, goal, goal, Subgoal(goal, goal))

    @eqx.filter_jit
    def several(state, key):
        arrays, static = eqx.partition(state, eqx.is_array)

        def one(arrays, key):
            draw_key, update_key = jax.random.split(key)
            new, _ = crl.update(eqx.combine(arrays, static), draw(draw_key), update_key)
            return eqx.filter(new, eqx.is_array), None

        arrays, _ = jax.lax.scan(one, arrays, jax.random.split(key, 1_000))
        return eqx.combine(arrays, static)

    state = several(state, KEY)
    start = jnp.linspace(-0.5, 0.5, 11)[:, None]
    action = crl.act(state, start, jnp.zeros((11, 1)), KEY, False)
    np.testing.assert_allclose(start + action, 0, atol=0.1)


def test_what_success_is_not_measured_on_is_not_read_of_a_goal():
    """A state at rest must look no nearer to a goal at rest than one that moves."""
    spec = replace(SPEC, observation_shape=(2,), goal_shape=(2,))
    state = crl.create(crl.Config(hidden=(8,)), spec, KEY)
    observation, action = jnp.ones((3, 2)), jnp.zeros((3, 1))
    at_rest, moving = jnp.array([[0.5, 0.0]] * 3), jnp.array([[0.5, 1.0]] * 3)
    for asked in (
        lambda goal: state.critic(observation, action, goal),
        lambda goal: state.critic.logits(observation, action, goal),
        lambda goal: crl.act(state, observation, goal, KEY, False),
    ):
        np.testing.assert_array_equal(asked(at_rest), asked(moving))
        assert not np.array_equal(asked(at_rest), asked(at_rest + 1))


def test_the_registry_has_it():
    agent = registry.get("crl")
    assert agent.value is not None
    assert agent.subgoals is None
