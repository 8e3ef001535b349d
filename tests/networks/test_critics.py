"""The twin critic: two networks of their own over state, action and goal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from midway.networks.critics import TwinCritic

BATCH = 6


def normal(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


OBSERVATION, ACTION, GOAL = normal(BATCH, 4), normal(BATCH, 2, seed=1), normal(BATCH, 3, seed=2)


@pytest.fixture(scope="module")
def critic() -> TwinCritic:
    return TwinCritic(9, (16, 16), "f32", key=jax.random.key(0))


def test_both_networks_read_state_action_goal(critic: TwinCritic):
    q = critic(OBSERVATION, ACTION, GOAL)
    inputs = jnp.concatenate([OBSERVATION, ACTION, GOAL], axis=-1)
    assert q.shape == (2, BATCH)
    np.testing.assert_allclose(q[0], critic.first(inputs)[:, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(q[1], critic.second(inputs)[:, 0], rtol=1e-5, atol=1e-6)


def test_networks_start_different(critic: TwinCritic):
    q = critic(OBSERVATION, ACTION, GOAL)
    assert abs(q[0] - q[1]).min() > 1e-4


def test_each_value_has_gradient_into_its_own_network_only(critic: TwinCritic):
    gradient = jax.grad(lambda critic: critic(OBSERVATION, ACTION, GOAL)[0].sum())(critic)
    assert all(abs(x).max() > 0 for x in jax.tree.leaves(gradient.first))
    assert all(abs(x).max() == 0 for x in jax.tree.leaves(gradient.second))


@pytest.mark.parametrize(
    "inputs",
    [
        (OBSERVATION, ACTION, GOAL[:-1]),
        (OBSERVATION, ACTION[0], GOAL),
        (OBSERVATION[:, None], ACTION, GOAL),
    ],
    ids=["batches differ", "an action without batch", "an axis too many"],
)
def test_wrong_shapes_are_refused(critic: TwinCritic, inputs):
    with pytest.raises(TypeCheckError):
        critic(*inputs)
