"""Codes in place of images: what is kept and learned once an encoder stays as it is."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from midway.training.folder import RunFolder
from small import SMALL

import midway
from drawing_here import needs_renderer
from midway.envs.push import IMAGE_SPEC, STATE_SPEC
from midway.replay import buffer
from midway.training import api, codes, step
from midway.training.arrays import named_arrays
from midway.training.config import TrainConfig
from midway.training.loop import Training
from midway.types import ConfigurationError

CODED = SMALL | {"encoder_batch_size": 0, "precision": "f32", "encoder_updates": 10}


def build(folder: Path) -> Training:
    return api.build(api.configure("push", "ris", changes=CODED), RunFolder(folder))


def advance(training: Training, updates: int) -> None:
    while training.updates < updates:
        training.advance()


def observations(training: Training) -> Any:
    return training.replay.rows["observation"]


def leaves(training: Training) -> dict[str, Any]:
    return {name: np.array(array) for name, array in named_arrays(training.arrays).items()}


@needs_renderer
def test_a_replay_is_encoded_with_the_encoders_last_update(tmp_path: Path) -> None:
    training = build(tmp_path)
    advance(training, 9)
    images = np.asarray(observations(training))
    assert images.dtype == np.uint8
    before = np.asarray(training.replay.num_rows)
    advance(training, 10)
    found = np.asarray(observations(training))
    assert found.shape == (*images.shape[:2], 16)
    encode = jax.jit(lambda images: training.state.encoder(images))
    for lane, count in enumerate(before):
        wanted = encode(images[lane, :count])
        np.testing.assert_allclose(found[lane, :count], wanted, rtol=1e-4, atol=1e-5)
    assert np.abs(found[:, : before.min()]).max() > 0


@needs_renderer
def test_all_but_the_encoder_begins_again_on_codes(tmp_path: Path) -> None:
    training = build(tmp_path)
    fresh = leaves(training)
    advance(training, 9)
    before = leaves(training)
    advance(training, 10)
    again = leaves(training)
    advance(training, 14)
    after = leaves(training)
    for name, array in again.items():
        part = name.split(".")[0]
        if part in ("encoder", "encoder_optimizer"):
            np.testing.assert_array_equal(array, after[name], err_msg=name)
        else:
            np.testing.assert_array_equal(array, fresh[name], err_msg=name)
    weights = [name for name in again if name.startswith("encoder.")]
    assert any((again[name] != before[name]).any() for name in weights)
    assert any((again[name] != after[name]).any() for name in again if name.startswith("policy."))


@needs_renderer
def test_what_comes_later_is_written_as_codes(tmp_path: Path) -> None:
    training = build(tmp_path)
    advance(training, 20)
    newest = np.asarray(training.replay.num_rows) - 1
    rows = np.asarray(observations(training))[np.arange(2), newest]
    np.testing.assert_array_equal(rows, training.collector.observation["observation"])


@needs_renderer
def test_a_coded_environment_is_the_environment_seen_through_the_encoder(tmp_path: Path) -> None:
    encoder = build(tmp_path).state.encoder
    encode = jax.jit(lambda images: encoder(images))
    bare = midway.make_vec("push", num_envs=2)
    coded = codes.CodedEnv(midway.make_vec("push", num_envs=2), encode)
    pairs = [(bare.reset(seed=3)[0], coded.reset(seed=3)[0])]
    actions = np.ones((2, 2), np.float32)
    pairs += [(bare.step(actions)[0], coded.step(actions)[0]) for _ in range(2)]
    mask = np.array([True, False])
    pairs += [tuple(e.reset(options={"reset_mask": mask})[0] for e in (bare, coded))]
    for images, seen in pairs:
        assert set(images) == set(seen)
        np.testing.assert_array_equal(images["achieved_state"], seen["achieved_state"])
        for name in codes.IMAGES:
            np.testing.assert_allclose(seen[name], encode(images[name]), rtol=1e-4, atol=1e-5)


@needs_renderer
def test_learning_from_codes_is_learning_from_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codes, "begun_again", lambda fresh, state: state)
    coded = build(tmp_path / "codes")
    advance(coded, 14)
    monkeypatch.setattr(codes, "encoder_that_stays", lambda state, updates: None)
    pictured = build(tmp_path / "images")
    advance(pictured, 14)
    assert observations(coded).ndim == 3
    assert observations(pictured).ndim == 5
    for one, other in zip(
        jax.tree.leaves(coded.arrays), jax.tree.leaves(pictured.arrays), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("asked", "images", "coded"), [(0, 64, 64), (16, 16, 64)])
def test_batches_are_smaller_only_while_images_are_encoded(
    asked: int, images: int, coded: int
) -> None:
    config = TrainConfig(batch_size=64, encoder_batch_size=asked)
    replay = buffer.create(IMAGE_SPEC, 204, 1)
    assert step.batch_size(config, replay) == images
    assert step.batch_size(config, codes.blank(replay)) == coded
    states = buffer.create(STATE_SPEC, 204, 1)
    assert step.batch_size(config, states) == 64


def test_a_batch_of_images_below_nothing_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="encoder_batch_size -1"):
        api.configure("push", changes={"encoder_batch_size": -1})
