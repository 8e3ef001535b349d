"""SAC: entropy in target and loss, the coefficient that holds it at -dim(A), order of its steps."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from midway import functional
from midway.agents import entropy, sac
from midway.networks.policies import Gaussian

KEY = jax.random.key(7)


def noise_for(case, seed: int = 0) -> jax.Array:
    shape = case.batch.action.shape
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def by_hand(actions: Gaussian, noise: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Return actions and log-densities from the change of variables, in float64."""
    mean, std = np.asarray(actions.mean, float), np.exp(np.asarray(actions.log_std, float))
    pre_tanh = mean + std * np.asarray(noise)
    log_density = scipy.stats.norm.logpdf(pre_tanh, mean, std)
    return np.tanh(pre_tanh), (log_density - np.log(1 - np.tanh(pre_tanh) ** 2)).sum(1)


def with_coefficient(state: sac.State, coefficient: float) -> sac.State:
    return replace(state, log_entropy_coefficient=jnp.log(coefficient))


def test_density_of_squashed_actions_integrates_to_one():
    grid = np.linspace(-1 + 1e-4, 1 - 1e-4, 20_001)
    mean, log_std = jnp.full((len(grid), 1), 0.3), jnp.full((len(grid), 1), -0.5)
    noise = (np.arctanh(grid)[:, None] - 0.3) / np.exp(-0.5)
    actions, log_density = Gaussian(mean, log_std).squashed(jnp.asarray(noise, jnp.float32))
    np.testing.assert_allclose(actions[:, 0], grid, atol=1e-6)
    assert scipy.integrate.trapezoid(np.exp(log_density), grid) == pytest.approx(1, abs=1e-3)


def test_sampled_actions_and_densities_by_hand(sac_case):
    state, batch, noise = sac_case.state, sac_case.batch, noise_for(sac_case)
    actions = state.policy(batch.observation, batch.goal)
    for ours, expected in zip(actions.squashed(noise), by_hand(actions, noise), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-5)


def test_critic_target_by_hand(sac_case):
    """-1 + 0.99 (min(Q1', Q2') - c log π), without what follows where the goal is reached."""
    state, batch, noise = with_coefficient(sac_case.state, 0.3), sac_case.batch, noise_for(sac_case)
    actions = state.policy(batch.next_observation, batch.goal)
    next_action, log_density = by_hand(actions, noise)
    q = state.target_critic(
        batch.next_observation, jnp.asarray(next_action, jnp.float32), batch.goal
    )
    soft_value = np.minimum(*np.asarray(q)) - 0.3 * log_density
    expected = -1 + 0.99 * np.where(batch.terminated, 0, soft_value)
    np.testing.assert_allclose(sac.critic_target(state, batch, noise), expected, rtol=1e-4)
    assert 0 < batch.terminated.sum() < len(batch.terminated)


def test_policy_loss_by_hand(sac_case):
    """Mean of c log π - min(Q1, Q2), by the online critics."""
    state, batch, noise = with_coefficient(sac_case.state, 0.3), sac_case.batch, noise_for(sac_case)
    action, log_density = by_hand(state.policy(batch.observation, batch.goal), noise)
    q = state.critic(batch.observation, jnp.asarray(action, jnp.float32), batch.goal)
    loss, (entropy, metrics) = sac.policy_loss(state.policy, state, batch, noise)
    assert float(loss) == pytest.approx(
        (0.3 * log_density - np.minimum(*np.asarray(q))).mean(), 1e-4
    )
    assert float(entropy) == pytest.approx(-log_density.mean(), rel=1e-4)
    assert metrics["policy/entropy"] == entropy


def test_entropy_loss_has_no_gradient_into_the_entropy():
    arguments = (jnp.asarray(0.5), jnp.asarray(-3.0))
    to_coefficient, to_entropy = jax.grad(entropy.loss, argnums=(0, 1))(*arguments, -2.0)
    assert to_coefficient == -3.0 - -2.0
    assert to_entropy == 0


@pytest.mark.parametrize(("bias", "direction"), [(2.0, 1), (-4.0, 1), (-0.5, -1)])
def test_entropy_coefficient_moves_towards_the_target_entropy(sac_case, bias, direction):
    """It grows while the entropy is below -dim(A) and falls while it is above.

    A std of e^-4 has too little entropy, and so has one of e^2: tanh presses it to the bounds. One
    of e^-0.5 is wider than the target.
    """
    zero = jax.tree.map(jnp.zeros_like, sac_case.state.policy)
    policy = eqx.tree_at(
        lambda p: p.network.layers[-1].bias, zero, jnp.asarray([0, 0, bias, bias], jnp.float32)
    )
    state, metrics = sac_case.update(replace(sac_case.state, policy=policy), sac_case.batch, KEY)
    assert (metrics["policy/entropy"] < -2) == (direction == 1)
    coefficient = metrics["policy/entropy_coefficient"]
    assert coefficient == pytest.approx(float(jnp.exp(state.log_entropy_coefficient)))
    # It starts at 1; Adam's first step is its learning rate, whatever the gradient's size.
    assert jnp.log(coefficient) == pytest.approx(direction * 0.01, rel=1e-3)


def test_steps_follow_each_other_and_change_their_own_networks_only(sac_case, monkeypatch):
    """Critics, policy, coefficient, target networks: each reads what was updated before it."""
    record = []

    def recorded(name):
        step = getattr(sac, name)

        def wrapper(state, *arguments):
            result = step(state, *arguments)
            record.append((name, state, result[0]))
            return result

        return wrapper

    def targets(online, target, rate):
        record.append(("targets", online, target))
        return target_update(online, target, rate)

    for name in ("update_critic", "update_policy"):
        monkeypatch.setattr(sac, name, recorded(name))
    target_update = functional.target_update
    monkeypatch.setattr(functional, "target_update", targets)
    eqx.filter_eval_shape(lambda: sac.update(sac_case.state, sac_case.batch, KEY)[0])

    assert [name for name, *_ in record] == ["update_critic", "update_policy", "targets"]
    (_, start, after_critic), (_, before_policy, after_policy), (_, online, target) = record
    assert start is sac_case.state
    assert before_policy is after_critic
    assert online is after_policy.critic
    assert target is start.target_critic
    for (before, after), fields in [
        ((start, after_critic), {"critic", "critic_optimizer", "encoder", "encoder_optimizer"}),
        (
            (before_policy, after_policy),
            {"policy", "policy_optimizer", "log_entropy_coefficient", "entropy_optimizer"},
        ),
    ]:
        differ = {x for x in vars(before) if getattr(before, x) is not getattr(after, x)}
        assert differ == fields
