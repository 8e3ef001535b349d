"""Freezing the encoder: from then on the run is one of an ordinary agent, on features."""

import csv
from fractions import Fraction
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from small import SMALL

import midway
from drawing_here import needs_renderer
from midway import api
from midway.agents import leap, ris
from midway.agents.registry import AGENTS
from midway.envs.push import IMAGE_SPEC, STATE_SPEC
from midway.errors import ConfigurationError
from midway.networks import encoder as encoders
from midway.replay import buffer
from midway.runs.folder import RunFolder
from midway.training import freeze, loop, state, step
from midway.training.arrays import named_arrays
from midway.training.checkpoint import Checkpoints
from midway.training.config import TrainConfig
from midway.training.state import Training

pytestmark = pytest.mark.usefixtures("short_episodes")

FROZEN = SMALL | {
    "encoder_batch_size": 0,
    "encoder_updates_per_step": 0.5,
    "updates_per_step": 2.0,
    "precision": "f32",
    "freeze_encoder_after": 10,
}


def build(folder: Path, **changes: Any) -> Training:
    config = api.configure("push", "ris", changes=FROZEN | changes)
    return state.start(api.setup_of(config, RunFolder(folder)))


def advance(training: Training, updates: int) -> None:
    while training.counters.updates < updates:
        loop.advance(training)


def observations(training: Training) -> Any:
    return training.replay.rows["observation"]


def leaves(tree: Any) -> dict[str, Any]:
    arrays = named_arrays(eqx.filter(tree, eqx.is_array))
    return {name: np.array(array) for name, array in arrays.items()}


def test_the_specification_of_features_keeps_what_success_is_measured_on() -> None:
    encoder = encoders.create(IMAGE_SPEC, ris.Config(), jax.random.key(0))
    spec = freeze.encoded_spec(IMAGE_SPEC, encoder)
    assert spec.observation_shape == spec.goal_shape == (encoders.NUM_FEATURES,)
    assert (spec.observation_dtype, spec.is_image) == ("float32", False)
    assert spec.image_shape == IMAGE_SPEC.observation_shape
    for name in ("task", "state_shape", "action_dim", "max_episode_steps"):
        assert getattr(spec, name) == getattr(IMAGE_SPEC, name)


def test_what_an_agent_keeps_is_what_it_names() -> None:
    config = leap.Config(hidden=(8,), vae_hidden=(8,), latent_size=2)
    first, second = (leap.create(config, STATE_SPEC, jax.random.key(number)) for number in range(2))
    kept = freeze.keep(leap.AGENT, first, second)
    pairs = zip(jax.tree.leaves(kept.vae), jax.tree.leaves(second.vae), strict=True)
    assert all(own is not taken and (own == taken).all() for own, taken in pairs)
    assert kept.policy is first.policy
    assert kept.vae_optimizer is first.vae_optimizer
    fresh = object.__new__(ris.State)
    assert freeze.keep(AGENTS["sac"], kept, fresh).policy is first.policy


@needs_renderer
def test_a_replay_is_encoded_with_the_encoders_last_update(tmp_path: Path) -> None:
    training = build(tmp_path)
    advance(training, 9)
    images = np.asarray(observations(training))
    assert images.dtype == np.uint8
    assert training.encoder is None
    before = np.asarray(training.replay.num_rows)
    advance(training, 10)
    found = np.asarray(observations(training))
    assert found.shape == (*images.shape[:2], 16)
    encoder: Any = training.encoder
    encode = jax.jit(lambda images: encoder(images))
    for lane, count in enumerate(before):
        wanted = encode(images[lane, :count])
        np.testing.assert_allclose(found[lane, :count], wanted, rtol=1e-4, atol=1e-5)
    assert np.abs(found[:, : before.min()]).max() > 0


@needs_renderer
def test_the_agent_begins_again_on_features_and_the_encoder_stays(tmp_path: Path) -> None:
    training = build(tmp_path)
    pictured = leaves(training.state)
    advance(training, 9)
    before = leaves(training.state.encoder)
    advance(training, 10)
    frozen, again = leaves(training.encoder), leaves(training.state)
    advance(training, 14)
    assert not any(name.startswith("encoder.") for name in again)
    for name, array in again.items():
        np.testing.assert_array_equal(array, pictured[name], err_msg=name)
    assert any((frozen[name] != before[name]).any() for name in frozen)
    for name, array in leaves(training.encoder).items():
        np.testing.assert_array_equal(array, frozen[name], err_msg=name)
    after = leaves(training.state)
    assert any((again[name] != after[name]).any() for name in again if name.startswith("policy."))


@needs_renderer
def test_what_comes_later_is_written_as_features(tmp_path: Path) -> None:
    training = build(tmp_path)
    advance(training, 20)
    newest = np.asarray(training.replay.num_rows) - 1
    rows = np.asarray(observations(training))[np.arange(2), newest]
    np.testing.assert_array_equal(rows, training.collector.observation["observation"])


@needs_renderer
def test_a_frozen_environment_is_the_environment_seen_through_the_encoder() -> None:
    encoder = encoders.create(IMAGE_SPEC, ris.Config(), jax.random.key(0))
    encode = jax.jit(lambda images: encoder(images))
    spec = freeze.encoded_spec(IMAGE_SPEC, encoder)
    bare = midway.make_vec("push", num_envs=2)
    frozen = freeze.FrozenEnv(midway.make_vec("push", num_envs=2), spec, encode)
    assert (frozen.goal_spec, frozen.num_envs) == (spec, 2)
    pairs = [(bare.reset(seed=3)[0], frozen.reset(seed=3)[0])]
    actions = np.ones((2, 2), np.float32)
    pairs += [(bare.step(actions)[0], frozen.step(actions)[0]) for _ in range(2)]
    mask = np.array([True, False])
    options = {"reset_mask": mask}
    pairs.append((bare.reset(options=options)[0], frozen.reset(options=options)[0]))
    for images, seen in pairs:
        assert set(images) == set(seen)
        np.testing.assert_array_equal(images["achieved_state"], seen["achieved_state"])
        for name in ("observation", "achieved_goal", "desired_goal"):
            np.testing.assert_allclose(seen[name], encode(images[name]), rtol=1e-4, atol=1e-5)


@needs_renderer
def test_agents_without_freezing_go_on(tmp_path: Path) -> None:
    training = build(tmp_path, freeze_encoder_after=0)
    advance(training, 14)
    assert training.encoder is None
    assert observations(training).dtype == np.uint8


@needs_renderer
def test_exact_resume_before_freezing(tmp_path: Path) -> None:
    """A checkpoint with images, continued until they are features (after: test_from_images.py)."""
    stop = 32
    whole = build(tmp_path / "whole")
    while whole.counters.steps < stop:
        loop.advance(whole)
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(stop, state.state_dict(whole))
    resumed = state.restore(build(tmp_path / "resumed"), checkpoints, stop)
    assert resumed.encoder is whole.encoder is None
    for training in (whole, resumed):
        advance(training, 14)
        assert training.encoder is not None
    for one, other in ((whole.encoder, resumed.encoder), (whole.arrays, resumed.arrays)):
        first, second = leaves(one), leaves(other)
        assert first.keys() == second.keys()
        for name in first:
            np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    np.testing.assert_array_equal(observations(whole), observations(resumed))


@needs_renderer
def test_a_saved_policy_holds_the_frozen_encoder(tmp_path: Path) -> None:
    run = midway.train("push", seed=1, out=tmp_path / "run", changes=FROZEN)
    arrays = load_file(run.path / "policy.safetensors")
    assert any(name.startswith(state.FROZEN) for name in arrays)
    policy = midway.load(run.path)
    assert policy.encoder is not None
    observation, _ = midway.make_vec("push", num_envs=2).reset(seed=0)
    features = policy.features(observation["observation"])
    assert features.shape == (2, 16)
    assert policy(observation["observation"], observation["desired_goal"]).shape == (2, 2)
    with (run.path / "metrics.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) > 2


@pytest.mark.parametrize(("asked", "images", "features"), [(0, 64, 64), (16, 16, 64)])
def test_batches_are_smaller_only_while_images_are_encoded(
    asked: int, images: int, features: int
) -> None:
    config = TrainConfig(batch_size=64, encoder_batch_size=asked)
    assert step.batch_size(config, IMAGE_SPEC) == images
    assert step.batch_size(config, IMAGE_SPEC.encoded(16)) == features
    assert step.batch_size(config, STATE_SPEC) == 64
    assert buffer.create(IMAGE_SPEC.encoded(16), 204, 1).rows["observation"].shape[2:] == (16,)


@given(
    num_envs=st.integers(1, 20),
    slow=st.sampled_from([0.0, 0.1, 0.25, 1 / 3, 1.0]),
    ratio=st.sampled_from([0.25, 1.0, 1.5]),
    updates=st.integers(1, 50),
)
def test_updates_follow_one_ratio_until_the_encoder_is_frozen_and_another_from_then_on(
    num_envs: int, slow: float, ratio: float, updates: int
) -> None:
    config = TrainConfig(
        num_envs=num_envs,
        random_steps=40,
        updates_per_step=ratio,
        encoder_updates_per_step=slow,
        freeze_encoder_after=updates,
    )
    spec, done, frozen_at, before = IMAGE_SPEC, 0, 0, slow or ratio
    for steps in range(num_envs, 1_000, num_envs):
        per_call = config.updates_per_call(spec.is_image)
        while config.updates_due(steps, spec) - done >= per_call:
            done += per_call
        exact = max(0, steps - 40) * before
        if not spec.is_image:
            exact = updates + (steps - 40 - updates / before) * ratio
        assert exact - per_call - 1e-6 < done <= max(exact + 1e-6, frozen_at)
        if spec.is_image and done >= updates:
            spec, frozen_at = spec.encoded(16), done
    assert config.updates_due(500, STATE_SPEC) == int(460 * ratio)


@pytest.mark.parametrize(
    "name", ["encoder_batch_size", "encoder_updates_per_step", "freeze_encoder_after"]
)
def test_numbers_below_nothing_are_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{name} -1"):
        api.configure("push", changes={name: -1})


def test_a_ratio_below_one_in_ten_thousand_is_one() -> None:
    config = TrainConfig(encoder_updates_per_step=1e-300, freeze_encoder_after=1)
    assert config.update_ratio(encoding=True) == Fraction(1, 10_000)
    assert config.updates_due(config.random_steps + 10_000, IMAGE_SPEC) == 1
    assert config.updates_due(config.random_steps + 10_001, IMAGE_SPEC.encoded(16)) == 2


def test_a_ratio_of_an_encoder_that_never_learns_is_refused(tmp_path: Path) -> None:
    config = api.configure("push", "leap", changes={"encoder_updates_per_step": 0.25})
    with pytest.raises(ConfigurationError, match="frozen before the first update"):
        state.check(api.setup_of(config, RunFolder(tmp_path)))
