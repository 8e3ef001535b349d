"""Agents on images: one encoder for all networks, trained by the critics' loss alone."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import registry, ris, sac
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.training import freeze
from midway.types import Batch, DistanceTask, EnvSpec, Outcome, Subgoal

IMAGE = (31, 31, 3)
"""The smallest images that the four convolutions leave a pixel of."""

TASK = DistanceTask(((0, 1), (2, 3)), 0.05)
SPEC = EnvSpec("images", IMAGE, "uint8", IMAGE, 2, 50, True, (4,), TASK)
KEY = jax.random.key(0)
BATCH = 8


def drawn():
    rng = np.random.default_rng(0)

    def pictures():
        return jnp.asarray(rng.integers(0, 256, (BATCH, *IMAGE), np.uint8))

    achieved, desired = jnp.asarray(rng.normal(size=(2, BATCH, 4)), jnp.float32)
    reward, terminated = TASK(achieved, desired)
    return Batch(
        observation=pictures(),
        action=jnp.asarray(rng.uniform(-1, 1, (BATCH, 2)), jnp.float32),
        reward=jnp.asarray(reward),
        terminated=terminated,
        next_observation=pictures(),
        goal=pictures(),
        subgoal_candidate=Subgoal(pictures(), pictures()),
        outcome=Outcome(achieved, desired),
    )


def made(name):
    agent = registry.get(name)
    return agent, agent.create(agent.Config(hidden=(16, 16)), SPEC, KEY)


def leaves(tree):
    return jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))


@pytest.mark.parametrize("name", ["ris", "sac", "tdm"])
def test_an_update_moves_every_network_and_stays_finite(name):
    agent, state = made(name)
    after, metrics = eqx.filter_jit(agent.update)(state, drawn(), KEY)
    assert all(np.isfinite(value) for value in metrics.values())
    for part in ("encoder", "policy"):
        pairs = zip(leaves(getattr(state, part)), leaves(getattr(after, part)), strict=True)
        assert any((old != new).any() for old, new in pairs)


@pytest.mark.parametrize("name", ["ris", "sac"])
def test_the_encoder_is_trained_by_the_critics_loss_of_the_current_image_alone(name):
    agent, state = made(name)
    after, _ = eqx.filter_jit(agent.update)(state, drawn(), KEY)
    count = {"ris": 4, "sac": 3}[name]
    encoding_key, target_key = jax.random.split(KEY, count)[:2]
    observation, batch = encoders.encode_batch(state.encoder, drawn(), encoding_key)
    module = {"ris": ris, "sac": sac}[name]
    target = module.critic_target(state, batch, jax.random.normal(target_key, (BATCH, 2)))

    def loss(encoder):
        q = state.critic(encoder(observation), batch.action, batch.goal)
        return 0.5 * ((q - target) ** 2).sum(0).mean()

    gradient = eqx.filter_grad(loss)(state.encoder)
    expected, _ = optimizer.step(
        state.encoder, gradient, state.encoder_optimizer, state.config.encoder_learning_rate
    )
    for found, wanted in zip(leaves(after.encoder), leaves(expected), strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-6)


def test_candidates_are_the_features_of_other_observations():
    _, state = made("ris")
    features = state.encoder(drawn().observation)
    candidate = encoders.candidates(state.encoder, drawn(), features)
    np.testing.assert_array_equal(candidate.observation[1:], features[:-1])
    np.testing.assert_array_equal(candidate.observation[0], features[-1])
    np.testing.assert_array_equal(candidate.achieved_goal, candidate.observation)


def test_subgoals_are_imagined_as_features():
    _, state = made("ris")
    features = state.encoder(drawn().observation)
    batch = drawn()._replace(observation=features, goal=features)
    imagined = ris.imagine(state, batch, KEY)
    assert imagined.observation.shape == (BATCH, 10, encoders.NUM_FEATURES)


@pytest.mark.parametrize("name", ["ris", "sac", "tdm"])
def test_acting_sees_images_as_they_are(name):
    agent, state = made(name)
    images, goals = drawn().observation, drawn().goal
    actions = agent.act(state, images, goals, KEY, explore=False)
    assert actions.shape == (BATCH, 2)
    alone = agent.act(state, images[3:4], goals[3:4], jax.random.key(5), explore=False)
    np.testing.assert_allclose(actions[3:4], alone, atol=1e-5)


@pytest.mark.parametrize("name", ["ris", "sac", "tdm"])
def test_on_features_of_a_frozen_encoder_an_agent_is_one_of_states(name):
    agent, pictured = made(name)
    encoder = agent.freezing.encoder(pictured)
    spec = freeze.encoded_spec(SPEC, encoder)
    assert (spec.observation_shape, spec.goal_shape) == (2 * ((encoders.NUM_FEATURES,),))
    assert (spec.image_shape, spec.is_image, spec.state_shape) == (IMAGE, False, (4,))
    state = agent.create(agent.Config(hidden=(16, 16)), spec, KEY)
    assert isinstance(state.encoder, encoders.StateEncoder)
    images = drawn()
    batch = images._replace(
        observation=encoder(images.observation),
        next_observation=encoder(images.next_observation),
        goal=encoder(images.goal),
        subgoal_candidate=Subgoal(*map(encoder, images.subgoal_candidate)),
    )
    after, metrics = eqx.filter_jit(agent.update)(state, batch, KEY)
    assert all(np.isfinite(value) for value in metrics.values())
    for part in ("critic", "policy"):
        pairs = zip(leaves(getattr(state, part)), leaves(getattr(after, part)), strict=True)
        assert any((old != new).any() for old, new in pairs)
    # The networks have the sizes of those of images: only what comes before them is gone.
    for part in set(agent.networks) - {"encoder"}:
        sizes = [[x.shape for x in leaves(getattr(s, part))] for s in (pictured, state)]
        assert sizes[0] == sizes[1]


@pytest.mark.parametrize("name", ["ris", "sac", "tdm"])
def test_the_value_reads_images_as_the_environment_shows_them(name):
    agent, state = made(name)
    images, goals = drawn().observation, drawn().goal
    found = agent.value.estimate(state, images, goals)
    features = state.encoder(images), state.encoder(goals)
    spec = freeze.encoded_spec(SPEC, state.encoder)
    reader = encoders.create(spec, agent.Config(), KEY)
    on_features = replace(state, encoder=reader)
    assert found.shape == (BATCH,)
    wanted = agent.value.estimate(on_features, *features)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
