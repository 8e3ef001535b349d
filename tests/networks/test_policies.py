"""Distributions over actions and subgoals, and the networks that give them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import TypeCheckError

from midway.networks.policies import Gaussian, GaussianPolicy, Laplace, SubgoalPolicy

BATCH, STATE, ACTION = 6, 4, 2


def normal(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy(2 * STATE, ACTION, (16, 16), "f32", key=jax.random.key(0))


@pytest.fixture(scope="module")
def subgoal_policy() -> SubgoalPolicy:
    return SubgoalPolicy(2 * STATE, STATE, (16, 16), "f32", key=jax.random.key(0))


def test_gaussian_sample_is_mean_plus_scaled_noise():
    actions = Gaussian(jnp.asarray([[1.0, -2.0]]), jnp.log(jnp.asarray([[0.5, 3.0]])))
    pre_tanh = actions.sample(jnp.asarray([[2.0, -1.0]]))
    np.testing.assert_allclose(pre_tanh, [[1 + 0.5 * 2, -2 + 3 * -1]], rtol=1e-6)
    expected = scipy.stats.norm.logpdf(pre_tanh, [1, -2], [0.5, 3]).sum()
    assert actions.log_density(pre_tanh)[0] == pytest.approx(expected)


def test_laplace_samples_follow_their_own_density():
    location, scale = np.asarray([3.0, -1.0]), np.asarray([0.5, 2.0])
    subgoals = Laplace(jnp.asarray(location)[None], jnp.log(jnp.asarray(scale))[None])
    samples = np.asarray(subgoals.sample(jax.random.key(0), 20_000)[0])
    for i in range(2):
        fit = scipy.stats.kstest(samples[:, i], scipy.stats.laplace(location[i], scale[i]).cdf)
        assert fit.pvalue > 1e-3
    assert abs(np.corrcoef(samples.T)[0, 1]) < 0.03
    expected = scipy.stats.laplace.logpdf(samples[:1], location, scale).sum()
    assert subgoals.log_density(jnp.asarray(samples[:1]))[0] == pytest.approx(expected, rel=1e-5)


def test_laplace_draws_different_subgoals_for_each_pair():
    subgoals = Laplace(jnp.zeros((BATCH, STATE)), jnp.zeros((BATCH, STATE)))
    samples = subgoals.sample(jax.random.key(0), 10)
    assert samples.shape == (BATCH, 10, STATE)
    assert len(np.unique(samples)) == samples.size


def test_policy_heads_are_mean_and_log_std(policy: GaussianPolicy):
    observation, goal = normal(BATCH, STATE), normal(BATCH, STATE, seed=1)
    actions = policy(observation, goal)
    outputs = policy.network(jnp.concatenate([observation, goal], axis=-1))
    np.testing.assert_allclose(actions.mean, outputs[:, :ACTION], rtol=1e-6)
    np.testing.assert_allclose(actions.log_std, outputs[:, ACTION:], rtol=1e-6)


def test_subgoal_policy_heads_are_location_and_log_scale(subgoal_policy: SubgoalPolicy):
    observation, goal = normal(BATCH, STATE), normal(BATCH, STATE, seed=1)
    subgoals = subgoal_policy(observation, goal)
    outputs = subgoal_policy.network(jnp.concatenate([observation, goal], axis=-1))
    np.testing.assert_allclose(subgoals.location, outputs[:, :STATE], rtol=1e-6)
    np.testing.assert_allclose(subgoals.log_scale, outputs[:, STATE:], rtol=1e-6)


@pytest.mark.parametrize(("bias", "clipped"), [(50.0, 2.0), (-50.0, -20.0)])
def test_scales_are_clipped_and_means_are_not(policy, subgoal_policy, bias, clipped):
    def biased(network):
        return eqx.tree_at(
            lambda n: n.network.layers[-1].bias,
            network,
            jnp.full_like(network.network.layers[-1].bias, bias),
        )

    pair = normal(BATCH, STATE), normal(BATCH, STATE, seed=1)
    actions, subgoals = biased(policy)(*pair), biased(subgoal_policy)(*pair)
    np.testing.assert_array_equal(actions.log_std, jnp.full((BATCH, ACTION), clipped))
    np.testing.assert_array_equal(subgoals.log_scale, jnp.full((BATCH, STATE), clipped))
    assert abs(actions.mean).min() > 40
    assert abs(subgoals.location).min() > 40


def test_prior_over_subgoals_equals_one_subgoal_at_a_time(policy: GaussianPolicy):
    observation, imagined = normal(BATCH, STATE), normal(BATCH, 10, STATE, seed=1)
    together = policy(observation[:, None], imagined)
    assert together.mean.shape == (BATCH, 10, ACTION)
    for i in range(10):
        alone = policy(observation, imagined[:, i])
        np.testing.assert_allclose(together.mean[:, i], alone.mean, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(together.log_std[:, i], alone.log_std, rtol=1e-4, atol=1e-6)


def test_wrong_shapes_are_refused(policy: GaussianPolicy):
    actions = policy(normal(BATCH, STATE), normal(BATCH, STATE))
    with pytest.raises(TypeCheckError):
        actions.log_density(jnp.zeros((BATCH, ACTION + 1)))
    with pytest.raises(TypeCheckError):
        actions.log_density(jnp.zeros((BATCH + 1, ACTION)))
    with pytest.raises(TypeError):
        policy(normal(BATCH, STATE), normal(BATCH, STATE + 1))
    with pytest.raises(TypeCheckError):
        policy(jnp.zeros((BATCH, STATE), int), normal(BATCH, STATE))
