"""RIS: the order of its steps, what each step may change, where gradients stop, both roles."""

import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway import functional
from midway.agents import ris
from midway.networks import encoder as encoders
from midway.networks.policies import Gaussian
from midway.types import Subgoal

KEY = jax.random.key(7)
STEPS = ("update_critic", "update_subgoal_policy", "update_policy", "update_copies")
CHANGES = {
    "update_critic": {"critic", "critic_optimizer", "encoder", "encoder_optimizer"},
    "update_subgoal_policy": {"subgoal_policy", "subgoal_optimizer"},
    "update_policy": {"policy", "policy_optimizer"},
    "update_copies": {"target_critic", "prior_policy"},
}


def replaced(before: ris.State, after: ris.State) -> set[str]:
    return {name for name in vars(before) if getattr(before, name) is not getattr(after, name)}


@pytest.fixture
def steps(ris_case, monkeypatch):
    """Trace an update; return each step's name with the states that go in and come out."""
    record = []

    def recorded(name):
        step = getattr(ris, name)

        def wrapper(state, *arguments):
            result = step(state, *arguments)
            record.append((name, state, result[0] if isinstance(result, tuple) else result))
            return result

        return wrapper

    for name in STEPS:
        monkeypatch.setattr(ris, name, recorded(name))

    def trace():
        record.append(("start", None, ris_case.state))
        state, _ = ris.update(ris_case.state, ris_case.batch, KEY)
        record.append(("end", state, None))

    eqx.filter_eval_shape(trace)
    return record


def test_steps_follow_the_papers_order_each_from_the_state_before_it(steps):
    """Critics, subgoal policy, policy, copies: each reads the networks updated just before."""
    assert [name for name, _, _ in steps] == ["start", *STEPS, "end"]
    for (_, _, before), (name, after, _) in itertools.pairwise(steps):
        assert before is after, name


def test_each_step_changes_its_own_network_and_nothing_else(steps):
    """No gradient step of one network moves another: not the critic by the policy's loss, ..."""
    for name, before, after in steps[1:-1]:
        assert replaced(before, after) == CHANGES[name], name


def test_subgoal_step_uses_the_updated_critic(pairs):
    state, batch = pairs.state, pairs.batch
    after, metrics = pairs.update(state, batch, KEY)

    @eqx.filter_jit
    def loss(critic):
        return ris.subgoal_loss(state.subgoal_policy, replace(state, critic=critic), batch)[0]

    assert metrics["subgoal/loss"] == pytest.approx(float(loss(after.critic)), rel=1e-4)
    assert metrics["subgoal/loss"] != pytest.approx(float(loss(state.critic)), rel=1e-3)


def test_critic_target_uses_the_policy_and_the_target_critics_alone(pairs):
    state, batch = pairs.state, pairs.batch
    noise = jnp.ones_like(batch.action)
    target = ris.critic_target(state, batch, noise)
    broken = jax.tree.map(lambda x: jnp.nan * x, state.critic)
    prior = jax.tree.map(lambda x: jnp.nan * x, state.prior_policy)
    np.testing.assert_array_equal(
        target, ris.critic_target(replace(state, critic=broken, prior_policy=prior), batch, noise)
    )


def test_critic_target_by_hand(pairs):
    """-1 + 0.99 min(Q1', Q2') at the sampled action, and -1 where the goal is reached."""
    state, batch = pairs.state, pairs.batch
    noise = jnp.asarray(np.random.default_rng(0).normal(size=batch.action.shape), jnp.float32)
    actions = state.policy(batch.next_observation, batch.goal)
    next_action = np.tanh(actions.mean + np.exp(actions.log_std) * noise)
    q = np.asarray(
        state.target_critic(batch.next_observation, jnp.asarray(next_action), batch.goal)
    )
    expected = -1 + 0.99 * np.where(batch.terminated, 0, np.minimum(q[0], q[1]))
    np.testing.assert_allclose(ris.critic_target(state, batch, noise), expected, rtol=1e-5)
    assert 0 < batch.terminated.sum() < len(batch.terminated)


def test_subgoal_loss_has_gradient_into_the_subgoal_policy_alone(pairs):
    """Not into the critic or the policy, by which the advantage is measured."""
    state, batch = pairs.state, pairs.batch
    networks = {name: getattr(state, name) for name in ris.AGENT.networks}

    @jax.jit
    @jax.grad
    def gradient_of(networks):
        return ris.subgoal_loss(networks["subgoal_policy"], replace(state, **networks), batch)[0]

    for name, gradient in gradient_of(networks).items():
        largest = [float(abs(x).max()) for x in jax.tree.leaves(gradient)]
        assert all((x > 0) == (name == "subgoal_policy") for x in largest), name


def test_subgoal_gradient_holds_the_weights_fixed(pairs):
    """The location enters the advantage too; no gradient may pass that way."""
    state, batch = pairs.state, pairs.batch
    advantage = ris.subgoal_advantage(
        state, batch, state.subgoal_policy(batch.observation, batch.goal).location
    )
    weight = functional.advantage_weights(advantage, state.config.advantage_temperature)
    candidate = encoders.as_vector(state.spec, batch.subgoal_candidate)

    @jax.jit
    def both(subgoal_policy):
        def likelihood(subgoal_policy):
            subgoals = subgoal_policy(batch.observation, batch.goal)
            return -(weight * subgoals.log_density(candidate)).sum()

        def loss(subgoal_policy):
            return ris.subgoal_loss(subgoal_policy, state, batch)[0]

        return jax.grad(likelihood)(subgoal_policy), jax.grad(loss)(subgoal_policy)

    expected, ours = map(jax.tree.leaves, both(state.subgoal_policy))
    for a, b in zip(ours, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * float(abs(b).max()))


def test_imagined_subgoals_carry_no_gradient(pairs):
    state, batch = pairs.state, pairs.batch

    @jax.jit
    @jax.grad
    def gradient_of(subgoal_policy):
        imagined = ris.imagine(replace(state, subgoal_policy=subgoal_policy), batch, KEY)
        return imagined.observation.sum() + imagined.achieved_goal.sum()

    gradient = gradient_of(state.subgoal_policy)
    assert all(abs(x).max() == 0 for x in jax.tree.leaves(gradient))


def test_imagined_subgoals_are_drawn_from_the_subgoal_policy(ris_case):
    state, batch, spec = ris_case.state, ris_case.batch, ris_case.spec
    imagined = ris.imagine(state, batch, KEY)
    assert imagined.observation.shape == (32, 10, *spec.observation_shape)
    assert imagined.achieved_goal.shape == (32, 10, *spec.goal_shape)
    subgoals = state.subgoal_policy(batch.observation, batch.goal)
    drawn = encoders.as_vector(spec, imagined)
    noise = (drawn - subgoals.location[:, None]) / jnp.exp(subgoals.log_scale)[:, None]
    # A standard Laplace has mean absolute value 1 and variance 2.
    assert abs(noise).mean() == pytest.approx(1, abs=0.1)
    assert (noise**2).mean() == pytest.approx(2, abs=0.4)
    assert noise.mean() == pytest.approx(0, abs=0.1)


def test_roles_of_a_subgoal_are_split_and_joined(ris_case):
    candidate = ris_case.batch.subgoal_candidate
    vector = encoders.as_vector(ris_case.spec, candidate)
    sizes = ris_case.spec.observation_shape[0], ris_case.spec.goal_shape[0]
    assert vector.shape[1] == (sizes[0] if ris_case.spec.goal_is_observation else sum(sizes))
    for ours, expected in zip(ris.as_subgoal(ris_case.spec, vector), candidate, strict=True):
        np.testing.assert_array_equal(ours, expected)


def test_advantage_reaches_a_subgoal_as_goal_and_leaves_it_as_observation(ris_case):
    """Cost max(|V(s, s_g)|, |V(s_g, g)|): of the mean subgoal minus that of the candidate."""
    batch = ris_case.batch
    # Values of the size that a trained critic has, some of them beyond the bounds.
    state = eqx.tree_at(
        lambda s: [x.layers[-1].bias for x in (s.critic.first, s.critic.second)],
        eqx.tree_at(
            lambda s: [x.layers[-1].weight for x in (s.critic.first, s.critic.second)],
            ris_case.state,
            replace_fn=lambda w: 200 * w,
        ),
        replace_fn=lambda b: b - 60,
    )
    location = state.subgoal_policy(batch.observation, batch.goal).location

    def v(observation, goal):
        action = jnp.tanh(state.policy(observation, goal).mean)
        return np.asarray(state.critic(observation, action, goal)).min(0)

    costs = []
    size = ris_case.spec.observation_shape[0]
    mean = (location, location)
    if not ris_case.spec.goal_is_observation:
        mean = (location[:, :size], location[:, size:])
    for observation, achieved_goal in (mean, batch.subgoal_candidate):
        legs = np.stack([v(batch.observation, achieved_goal), v(observation, batch.goal)])
        costs.append(np.abs(np.clip(legs, -100, 0)).max(0))
    expected = costs[0] - costs[1]
    np.testing.assert_allclose(
        ris.subgoal_advantage(state, batch, location), expected, rtol=1e-4, atol=1e-3
    )
    assert np.std(expected) > 1
    assert (np.asarray(costs) == 100).any()


def test_equal_advantages_give_every_candidate_the_same_weight(pairs):
    """With a constant critic all 32 candidates count, and the loss is their mean likelihood."""
    state, batch = pairs.state, pairs.batch
    constant = jax.tree.map(jnp.zeros_like, state.critic)
    loss, metrics = ris.subgoal_loss(state.subgoal_policy, replace(state, critic=constant), batch)
    subgoals = state.subgoal_policy(batch.observation, batch.goal)
    candidate = encoders.as_vector(state.spec, batch.subgoal_candidate)
    assert metrics["subgoal/effective_candidates"] == pytest.approx(32, rel=1e-5)
    assert metrics["subgoal/advantage"] == 0
    assert loss == pytest.approx(-float(subgoals.log_density(candidate).mean()), rel=1e-4)


def test_policy_equal_to_its_prior_has_no_divergence(pairs):
    """If every imagined subgoal is the goal, the prior is the copy of the policy itself."""
    state, batch = pairs.state, pairs.batch
    noise = jnp.asarray(np.random.default_rng(0).normal(size=batch.action.shape), jnp.float32)
    goals = jnp.tile(batch.goal[:, None], (1, 10, 1))
    loss, metrics = ris.policy_loss(state.policy, state, batch, noise, goals)
    assert metrics["policy/kl_to_prior"] == pytest.approx(0, abs=1e-5)
    pre_tanh = state.policy(batch.observation, batch.goal).sample(noise)
    q = state.critic(batch.observation, jnp.tanh(pre_tanh), batch.goal).min(0)
    assert loss == pytest.approx(-float(q.mean()), rel=1e-4)


def far_subgoals(rng: np.random.Generator) -> jax.Array:
    """Return subgoals far from the goals, where a fresh policy's prior differs from it."""
    return jnp.asarray(10 * rng.normal(size=(32, 10, 2)), jnp.float32)


def test_policy_loss_draws_towards_the_prior_as_the_weight_says(pairs):
    """The loss is linear in the KL weight: α times the divergence more than without it."""
    batch, state = pairs.batch, pairs.state
    noise = jnp.zeros_like(batch.action)
    imagined = far_subgoals(np.random.default_rng(0))
    losses = []
    for kl_weight in (0.0, 0.1, 10.0):
        other = replace(state, config=replace(state.config, kl_weight=kl_weight))
        loss, metrics = ris.policy_loss(state.policy, other, batch, noise, imagined)
        losses.append(float(loss))
    kl = float(metrics["policy/kl_to_prior"])
    assert abs(kl) > 0.01
    assert losses[1] - losses[0] == pytest.approx(0.1 * kl, rel=1e-4)
    assert losses[2] - losses[0] == pytest.approx(10 * kl, rel=1e-4)


def test_divergence_is_that_of_the_actions_before_the_tanh(pairs):
    """Eq. 19 by hand: one sample, log π(u) - log(mean of ten π'(u) + ε)."""
    state, batch = pairs.state, pairs.batch
    rng = np.random.default_rng(0)
    noise = jnp.asarray(rng.normal(size=batch.action.shape), jnp.float32)
    imagined = far_subgoals(rng)
    _, metrics = ris.policy_loss(state.policy, state, batch, noise, imagined)

    def density(actions: Gaussian, x: np.ndarray) -> np.ndarray:
        std = np.exp(np.asarray(actions.log_std, np.float64))
        z = (x - np.asarray(actions.mean)) / std
        return np.prod(np.exp(-0.5 * z**2) / (std * np.sqrt(2 * np.pi)), axis=-1)

    actions = state.policy(batch.observation, batch.goal)
    sampled = np.asarray(actions.mean) + np.exp(np.asarray(actions.log_std)) * np.asarray(noise)
    each = [
        density(state.prior_policy(batch.observation, imagined[:, i]), sampled) for i in range(10)
    ]
    divergence = np.log(density(actions, sampled)) - np.log(np.mean(each, axis=0) + 1e-16)
    assert metrics["policy/kl_to_prior"] == pytest.approx(divergence.mean(), rel=1e-4)
    entropy = -np.log(density(actions, sampled)).mean()
    assert metrics["policy/entropy"] == pytest.approx(entropy, rel=1e-4)


def test_subgoal_policy_finds_the_only_candidate(pairs):
    """Whatever the weights are, the likeliest location of one repeated candidate is itself."""
    state, batch = pairs.state, pairs.batch
    point = jax.tree.map(lambda x: jnp.full_like(x, 0.7), batch.subgoal_candidate)
    batch = batch._replace(subgoal_candidate=Subgoal(*point))
    step = eqx.filter_jit(ris.update_subgoal_policy)
    for _ in range(150):
        state, metrics = step(state, batch)
    subgoals = state.subgoal_policy(batch.observation, batch.goal)
    weight = functional.advantage_weights(
        ris.subgoal_advantage(state, batch, subgoals.location), state.config.advantage_temperature
    )
    error = abs(subgoals.location - 0.7).mean(1)
    assert (weight * error).sum() < 0.1
    assert metrics["subgoal/scale"] < 0.3
