"""The cross-entropy method: known minima, the refit by hand, the schedule of elites."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.planning import cem

KEY = jax.random.key(0)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 4)])
def test_the_minimum_of_a_quadratic_is_found(shape):
    best = jax.random.normal(jax.random.key(1), shape)

    def cost(candidates):
        return ((candidates - best) ** 2).reshape(len(candidates), -1).sum(1)

    elites = cem.elite_schedule(400, 30, (0.2, 0.05))
    found, smallest = cem.minimise(cost, jnp.zeros(shape), 2.0, elites, 400, KEY)
    np.testing.assert_allclose(found, best, atol=0.02)
    np.testing.assert_allclose(smallest, cost(found[None])[0], rtol=1e-5)


def test_the_deeper_of_two_valleys_is_found():
    def cost(candidates):
        x = candidates[:, 0]
        return jnp.minimum((x - 2) ** 2, (x + 2) ** 2 - 0.5)

    elites = cem.elite_schedule(500, 20, (0.25, 0.02))
    found, smallest = cem.minimise(cost, jnp.zeros(1), 1.5, elites, 500, KEY)
    assert found[0] == pytest.approx(-2, abs=0.02)
    assert smallest == pytest.approx(-0.5, abs=1e-3)


def test_the_result_is_the_best_candidate_of_the_last_iteration():
    seen = []

    def cost(candidates):
        jax.debug.callback(lambda c: seen.append(np.asarray(c)), candidates, ordered=True)
        return jnp.abs(candidates).sum(1)

    found, _ = cem.minimise(cost, jnp.zeros(2), 1.0, jnp.array([5, 5, 5]), 16, KEY)
    jax.effects_barrier()
    assert [len(candidates) for candidates in seen] == [16, 16, 16]
    last = seen[-1]
    np.testing.assert_array_equal(found, last[np.abs(last).sum(1).argmin()])


def test_the_first_iteration_draws_from_the_given_gaussian():
    drawn = []

    def cost(candidates):
        jax.debug.callback(lambda c: drawn.append(np.asarray(c)), candidates)
        return candidates[:, 0]

    cem.minimise(cost, jnp.array([3.0, -1.0]), 1.5, jnp.array([10]), 20_000, KEY)
    jax.effects_barrier()
    np.testing.assert_allclose(drawn[0].mean(0), [3, -1], atol=0.05)
    np.testing.assert_allclose(drawn[0].std(0), [1.5, 1.5], atol=0.05)


def test_refit_by_hand():
    candidates = jnp.array([[1.0, 0.0], [3.0, 4.0], [100.0, 100.0], [-50.0, 9.0]])
    costs = jnp.array([0.5, 0.1, 7.0, 7.0])
    mean, std = cem.refit(candidates, costs, jnp.array(2))
    np.testing.assert_allclose(mean, [2, 2])
    np.testing.assert_allclose(std, [1, 2])


def test_equal_costs_do_not_add_elites():
    mean, _ = cem.refit(jnp.arange(4.0)[:, None], jnp.zeros(4), jnp.array(1))
    assert float(mean[0]) in (0.0, 1.0, 2.0, 3.0)


def test_the_schedule_of_the_ant():
    elites = cem.elite_schedule(10_000, 50, (0.25, 0.01))
    assert elites.tolist() == [2_500] * 25 + [100] * 25


def test_there_is_always_an_elite():
    assert cem.elite_schedule(10, 4, (0.5, 0.01)).tolist() == [5, 5, 1, 1]


def test_same_key_same_plan():
    def plan(key):
        elites = jnp.array([4, 4])
        return cem.minimise(lambda c: (c**2).sum(1), jnp.ones(2), 1.0, elites, 32, key)[0]

    assert jnp.array_equal(plan(KEY), plan(KEY))
    assert not jnp.array_equal(plan(KEY), plan(jax.random.key(5)))
