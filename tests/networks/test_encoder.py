"""Encoders: sizes and start of appendix B, random shifts, and what features depend on."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.networks import encoder as encoders
from midway.networks.encoder import NUM_FEATURES
from midway.networks.mlp import Precision
from midway.types import Batch, ConfigurationError, DistanceTask, EnvSpec, Subgoal

KEY = jax.random.key(0)


@dataclass(frozen=True)
class Config:
    """Appendix B."""

    random_shift: int = 8
    image_pooling: int = 1
    precision: Precision = "f32"


CONFIG = Config()
IMAGE = (84, 84, 3)
TASK = DistanceTask(((0, 1),), 0.5)
IMAGES = EnvSpec("images", IMAGE, "uint8", IMAGE, 2, 50, True, (4,), TASK)
STATES = EnvSpec("states", (5,), "float32", (2,), 2, 50, False, None, TASK)


def pictures(count, seed=0):
    return jnp.asarray(np.random.default_rng(seed).integers(0, 256, (count, *IMAGE), np.uint8))


@pytest.fixture(scope="module")
def encoder():
    return encoders.create(IMAGES, CONFIG, KEY)


def test_layers_are_those_of_the_appendix(encoder):
    shapes = [layer.weight.shape for layer in encoder.convolutions]
    assert shapes == [(3, 3, 3, 32), *[(3, 3, 32, 32)] * 3]
    assert [layer.stride for layer in encoder.convolutions] == [2, 2, 2, 1]
    assert encoder.linear.weight.shape == (7 * 7 * 32, NUM_FEATURES)
    assert encoders.feature_sizes(IMAGES) == (16, 16)
    assert encoders.feature_sizes(STATES) == (5, 2)


def test_start_is_orthogonal_in_the_centre(encoder):
    for layer in encoder.convolutions:
        tap = layer.weight[1, 1]
        assert jnp.count_nonzero(layer.weight) == tap.size
        smaller = tap @ tap.T if tap.shape[0] < tap.shape[1] else tap.T @ tap
        np.testing.assert_allclose(smaller, 2 * jnp.eye(len(smaller)), atol=1e-5)
        assert not layer.bias.any()
    product = encoder.linear.weight.T @ encoder.linear.weight
    np.testing.assert_allclose(product, jnp.eye(NUM_FEATURES), atol=1e-5)


def test_features_by_the_start_of_the_network(encoder):
    """With centre taps alone, the features see one pixel for each of the 7 x 7 places."""
    images = pictures(2)
    places = [1 + 2 * (1 + 2 * (1 + 2 * (1 + i))) for i in range(7)]
    x = np.asarray(images, np.float64)[:, places][:, :, places] / 255
    for layer in encoder.convolutions:
        x = np.maximum(x @ np.asarray(layer.weight[1, 1], np.float64), 0)
    expected = x.reshape(2, -1) @ np.asarray(encoder.linear.weight, np.float64)
    np.testing.assert_allclose(encoder(images), expected, rtol=1e-4, atol=1e-4)


def test_an_image_has_the_same_features_in_any_batch(encoder):
    images = pictures(19)
    np.testing.assert_allclose(encoder(images)[17:], encoder(images[17:]), rtol=1e-4, atol=1e-5)


def test_random_shift_moves_each_image_by_the_offset_drawn_for_it(encoder):
    images = pictures(32)
    moved = encoder.augment(images, KEY)
    assert moved.shape == images.shape
    assert moved.dtype == jnp.uint8
    corners = np.asarray(jax.random.randint(KEY, (32, 2), 0, 17))
    assert corners.min() == 0
    assert corners.max() == 16
    framed = np.pad(images, ((0, 0), (8, 8), (8, 8), (0, 0)))
    for image, frame, (row, column) in zip(moved, framed, corners, strict=True):
        np.testing.assert_array_equal(image, frame[row : row + 84, column : column + 84])
    assert (encoder.augment(images, jax.random.key(1)) != moved).any()


def test_states_are_their_own_features():
    encoder = encoders.create(STATES, CONFIG, KEY)
    states = jax.random.normal(KEY, (3, 5))
    np.testing.assert_array_equal(encoder(encoder.augment(states, KEY)), states)
    np.testing.assert_array_equal(encoder.states(states), states)


def test_states_are_read_from_the_origin_in_the_unit_of_the_environment():
    spec = replace(STATES, origin=(1.0, 2.0, 0.0, 0.0, -1.0), unit=0.1)
    encoder = encoders.create(spec, CONFIG, KEY)
    states = jnp.array([[1.1, 2.0, 0.3, 0.0, -1.5]])
    features = encoder(states)
    np.testing.assert_allclose(features, [[1.0, 0.0, 3.0, 0.0, -5.0]], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(encoder.states(features), states, rtol=1e-6, atol=1e-7)


def batch_of_pictures():
    images = pictures(4, 1)
    return Batch(
        observation=images,
        action=jnp.zeros((4, 2)),
        reward=-jnp.ones(4),
        terminated=jnp.zeros(4, bool),
        next_observation=pictures(4, 2),
        goal=pictures(4, 3),
        subgoal_candidate=Subgoal(images, images),
    )


def test_features_of_what_follows_have_no_gradient_and_the_observation_stays_an_image(encoder):
    batch = batch_of_pictures()
    observation, encoded = encoders.encode_batch(encoder, batch, KEY)
    assert observation.shape == (4, *IMAGE)
    assert observation.dtype == jnp.uint8
    assert encoded.next_observation.shape == encoded.goal.shape == (4, NUM_FEATURES)

    @eqx.filter_grad
    def gradient(encoder):
        encoded = encoders.encode_batch(encoder, batch, KEY)[1]
        return (encoded.goal**2 + encoded.next_observation**2).sum()

    assert not any(leaf.any() for leaf in jax.tree.leaves(gradient(encoder)))


def test_pooling_averages_squares_of_pixels():
    image = jax.random.uniform(KEY, (2, 6, 4, 3))
    found = encoders.pooled(image, 2)
    assert found.shape == (2, 3, 2, 3)
    np.testing.assert_allclose(found[1, 2, 1], image[1, 4:6, 2:4].mean((0, 1)), rtol=1e-5)
    np.testing.assert_array_equal(encoders.pooled(image, 1), image)


def test_features_of_pooled_images_do_not_see_what_averages_out():
    encoder = encoders.create(IMAGES, replace(CONFIG, image_pooling=2), KEY)
    checks = jnp.indices((84, 84)).sum(0) % 2 * 255
    checkered = jnp.broadcast_to(checks[None, :, :, None], (1, *IMAGE)).astype(jnp.uint8)
    np.testing.assert_allclose(encoder(checkered), encoder(255 - checkered), rtol=1e-5)
    assert encoder(checkered).shape == (1, NUM_FEATURES)


@pytest.mark.parametrize("pooling", [0, 3, 5])
def test_pooling_that_leaves_no_image_is_refused(pooling):
    with pytest.raises(
        ConfigurationError, match=f"image_pooling {pooling}: must divide .* 84 x 84"
    ):
        encoders.create(IMAGES, replace(CONFIG, image_pooling=pooling), KEY)


def test_no_shift_leaves_images_as_they_are():
    encoder = encoders.create(IMAGES, replace(CONFIG, random_shift=0), KEY)
    images = pictures(3)
    np.testing.assert_array_equal(encoder.augment(images, KEY), images)


def test_every_part_of_a_batch_is_shifted_by_draws_of_its_own(encoder):
    batch = batch_of_pictures()
    observation, encoded = encoders.encode_batch(encoder, batch, KEY)
    keys = jax.random.split(KEY, 3)
    np.testing.assert_array_equal(observation, encoder.augment(batch.observation, keys[0]))
    parts = zip((batch.next_observation, batch.goal), keys[1:], strict=True)
    wanted = [encoder(encoder.augment(images, key)) for images, key in parts]
    np.testing.assert_allclose(encoded.next_observation, wanted[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(encoded.goal, wanted[1], rtol=1e-4, atol=1e-5)


def test_what_the_environment_shows_is_encoded_for_a_function_of_features(encoder):
    class State:
        def __init__(self):
            self.encoder = encoder

    def function(state, observation, goal, *others):
        return observation, goal, others

    images, goals = pictures(2, 4), pictures(2, 5)
    found = encoders.on_observations(function)(State(), images, goals, 7)
    np.testing.assert_array_equal(found[0], encoder(images))
    np.testing.assert_array_equal(found[1], encoder(goals))
    assert found[2] == (7,)
