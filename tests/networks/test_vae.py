"""Autoencoders: shapes, losses by hand, and reconstruction after a short training."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.networks import optimizer, vae
from midway.types import DistanceTask, EnvSpec

KEY = jax.random.key(0)
TASK = DistanceTask(((0, 1),), 0.5)
IMAGE = (84, 84, 3)
SPECS = {
    "states": EnvSpec("states", (5,), "float32", (5,), 2, 50, True, None, TASK),
    "pairs": EnvSpec("pairs", (5,), "float32", (2,), 2, 50, False, None, TASK),
    "images": EnvSpec("images", IMAGE, "uint8", IMAGE, 2, 50, True, (4,), TASK),
}


@pytest.fixture(scope="module")
def image_vae():
    return vae.ImageVAE(4, key=KEY)


# Compiled whole: layer by layer, in every size, takes minutes and a gigabyte.
encoded, decoded = eqx.filter_jit(vae.ImageVAE.encode), eqx.filter_jit(vae.ImageVAE.decode)


@eqx.filter_jit
def reconstruction_error(model, states):
    return model.error(states, model.decode(model.encode(states).mean)).mean()


def trained(model, states, kl_weight, steps, rate=3e-3, batch=64):
    """Return the autoencoder after some steps of Adam."""

    def step(carry, key):
        model, state = carry
        rows_key, noise_key = jax.random.split(key)
        rows = states[jax.random.randint(rows_key, (batch,), 0, len(states))]
        noise = jax.random.normal(noise_key, (batch, model_latents))
        gradient = eqx.filter_grad(lambda m: vae.loss(m, rows, noise, kl_weight)[0])(model)
        return optimizer.step(model, gradient, state, rate), None

    model_latents = eqx.filter_eval_shape(type(model).encode, model, states[:1]).mean.shape[1]
    carry = (model, optimizer.init(model))
    return jax.jit(lambda c, k: jax.lax.scan(step, c, k))(carry, jax.random.split(KEY, steps))[0][0]


def test_kl_by_hand():
    latent = vae.Latent(jnp.array([[1.0, -2.0]]), jnp.log(jnp.array([[4.0, 0.25]])))
    expected = 0.5 * ((1 + 4 - 1 - np.log(4)) + (4 + 0.25 - 1 - np.log(0.25)))
    np.testing.assert_allclose(latent.kl(), [expected], rtol=1e-6)
    standard = vae.Latent(jnp.zeros((3, 2)), jnp.zeros((3, 2)))
    np.testing.assert_array_equal(standard.kl(), jnp.zeros(3))


def test_samples_have_the_distribution():
    latent = vae.Latent(jnp.full((50_000, 1), 3.0), jnp.full((50_000, 1), jnp.log(4.0)))
    samples = latent.sample(jax.random.normal(KEY, (50_000, 1)))
    assert samples.mean() == pytest.approx(3, abs=0.05)
    assert samples.std() == pytest.approx(2, abs=0.05)


def test_states_are_standardised_and_constant_entries_only_centred():
    states = jnp.array([[0.0, 5.0], [4.0, 5.0]])
    model = vae.StateVAE(2, 1, (8,), key=KEY).standardised(states)
    np.testing.assert_allclose(model.center, [2, 5])
    np.testing.assert_allclose(model.scale, [2, 1])
    error = model.error(states, states + jnp.array([2.0, 1.0]))
    np.testing.assert_allclose(error, [1, 1])  # ((2 / 2)² + 1²) / 2
    # Output layers start small: a new decoder returns about the mean of the data.
    np.testing.assert_allclose(model.decode(jnp.ones((1, 1))), [[2, 5]], atol=0.05)


def test_standardisation_is_not_learned():
    states = jax.random.normal(KEY, (64, 3)) * 7 + 2
    model = vae.StateVAE(3, 2, (8,), key=KEY).standardised(states)
    after = trained(model, states, 1e-3, 5)
    assert jnp.array_equal(after.center, model.center)
    assert jnp.array_equal(after.scale, model.scale)
    assert not jnp.array_equal(after.decoder.layers[0].weight, model.decoder.layers[0].weight)


def test_states_on_a_plane_are_reconstructed_from_two_numbers():
    position = jax.random.uniform(KEY, (2_000, 2), minval=-8.0, maxval=8.0)
    states = jnp.concatenate([position, jnp.full((2_000, 2), 0.565), -position[:, :1]], axis=1)
    model = vae.StateVAE(5, 2, (32, 32), key=KEY).standardised(states)
    model = trained(model, states, 1e-3, 1_500)
    reconstruction = model.decode(model.encode(states).mean)
    distance = jnp.linalg.norm((reconstruction - states)[:, :2], axis=1)
    assert distance.mean() < 0.25
    latents = model.encode(states)
    assert 0.5 < latents.mean.std() < 2  # the prior holds the latents together


def test_loss_is_error_plus_weighted_divergence():
    states = jax.random.normal(KEY, (16, 3))
    model = vae.StateVAE(3, 2, (8,), key=KEY)
    for weight in (0.0, 2.0):
        total, metrics = vae.loss(model, states, jnp.zeros((16, 2)), weight)
        expected = metrics["vae/error"] + weight * metrics["vae/kl"]
        np.testing.assert_allclose(total, expected, rtol=1e-6)
    latent = model.encode(states)
    by_hand = ((states - model.decode(latent.mean)) ** 2).mean()
    np.testing.assert_allclose(metrics["vae/error"], by_hand, rtol=1e-5)


def test_image_layers_have_the_sizes_of_the_appendix():
    model = eqx.filter_eval_shape(vae.ImageVAE, 16, key=KEY)
    images = jax.ShapeDtypeStruct((2, *IMAGE), jnp.float32)
    sizes = [images.shape[1:]]
    for layer in model.encoder:
        images = eqx.filter_eval_shape(vae.Filter.reduce, layer, images)
        sizes.append(images.shape[1:])
    assert sizes == [(84, 84, 3), (27, 27, 16), (8, 8, 16), (2, 2, 32)]
    for layer in model.decoder:
        images = eqx.filter_eval_shape(vae.Filter.enlarge, layer, images)
        sizes.append(images.shape[1:])
    assert sizes[4:] == [(8, 8, 32), (27, 27, 16), (84, 84, 3)]
    assert [layer.weight.shape[0] for layer in model.encoder] == [5, 5, 5]
    assert [layer.weight.shape[0] for layer in model.decoder] == [5, 6, 6]


@pytest.mark.parametrize(("kernel", "stride"), [(5, 3), (6, 3), (4, 2), (3, 1)])
def test_enlarging_is_the_transpose_of_reducing(kernel, stride):
    """<reduce(x), y> = <x, enlarge(y)> with the channels exchanged, biases left out."""
    there = vae.Filter(kernel, stride, 2, 3, key=KEY)
    back = vae.Filter(kernel, stride, 3, 2, key=KEY)
    there = eqx.tree_at(lambda f: f.bias, there, jnp.zeros(3))
    weight = there.weight.swapaxes(2, 3)
    back = eqx.tree_at(lambda f: (f.weight, f.bias), back, (weight, jnp.zeros(2)))
    small = jax.random.normal(KEY, (2, 4, 5, 3))
    enlarged = eqx.filter_jit(vae.Filter.enlarge)(back, small)
    assert enlarged.shape == (2, 3 * stride + kernel, 4 * stride + kernel, 2)
    large = jax.random.normal(jax.random.key(1), enlarged.shape)
    reduced = eqx.filter_jit(vae.Filter.reduce)(there, large)
    products = np.vdot(reduced, small), np.vdot(large, enlarged)
    np.testing.assert_allclose(*products, rtol=1e-4)


def test_images_are_decoded_in_blocks_without_a_trace(image_vae):
    latent = jax.random.normal(KEY, (vae.BLOCK + 3, 4))
    one_by_one = np.concatenate([decoded(image_vae, row[None]) for row in latent])
    np.testing.assert_allclose(decoded(image_vae, latent), one_by_one, atol=1e-5)


def test_image_values_may_be_bytes_or_shares(image_vae):
    image = np.random.default_rng(0).integers(0, 256, (3, *IMAGE), np.uint8)
    share = np.asarray(image / 255, np.float32)
    latent = encoded(image_vae, image)
    assert latent.mean.shape == latent.log_variance.shape == (3, 4)
    np.testing.assert_allclose(latent.mean, encoded(image_vae, share).mean, atol=1e-5)
    assert latent.log_variance.min() >= np.log(1e-4) - 1e-5
    error = eqx.filter_jit(vae.ImageVAE.error)(image_vae, image, share + np.float32(0.1))
    np.testing.assert_allclose(error, 84 * 84 * 3 * 0.01, rtol=1e-4)


def test_images_of_a_moving_square_are_reconstructed(image_vae):
    corners = [(row, column) for row in (0, 50) for column in (0, 50)]
    images = np.zeros((len(corners), *IMAGE), np.uint8)
    for image, (row, column) in zip(images, corners, strict=True):
        image[row : row + 30, column : column + 30] = 255
    before = reconstruction_error(image_vae, images)
    after = reconstruction_error(
        trained(image_vae, jnp.asarray(images), 1e-3, 120, batch=4), images
    )
    assert after < 0.3 * before


def test_images_are_standardised_by_their_mean_and_one_deviation(image_vae):
    images = np.random.default_rng(0).integers(0, 256, (6, *IMAGE), np.uint8)
    model = image_vae.standardised(jnp.asarray(images))
    np.testing.assert_allclose(model.center, (images / 255).mean(0), atol=1e-6)
    np.testing.assert_allclose(model.scale, (images / 255).var(0).mean() ** 0.5, rtol=1e-4)
    shown = (jnp.asarray(images) / 255 - model.center) / model.scale
    np.testing.assert_allclose(
        encoded(model, images).mean, encoded(image_vae, shown).mean, atol=1e-4
    )
    latent = jax.random.normal(KEY, (2, 4))
    expected = decoded(image_vae, latent) * model.scale + model.center
    np.testing.assert_allclose(decoded(model, latent), expected, atol=1e-5)
    still = image_vae.standardised(jnp.asarray(images[:1]))
    assert np.isfinite(encoded(still, images[:1]).mean).all()


def test_a_small_square_on_a_background_is_reconstructed(image_vae):
    corners = [(row, column) for row in (10, 60) for column in (10, 60)]
    images = np.full((len(corners), *IMAGE), 130, np.uint8)
    for image, (row, column) in zip(images, corners, strict=True):
        image[row : row + 8, column : column + 8] = 255
    model = image_vae.standardised(jnp.asarray(images))
    before = ((images / 255 - np.asarray(model.center)) ** 2).sum((1, 2, 3)).mean()
    model = trained(model, jnp.asarray(images), 0.1, 150, batch=4)
    assert reconstruction_error(model, images) < 0.5 * before


@pytest.mark.parametrize(("kind", "size"), [("states", 5), ("pairs", 7), ("images", None)])
def test_create_suits_the_environment(kind, size):
    model = eqx.filter_eval_shape(lambda key: vae.create(SPECS[kind], 3, (16, 8), key), KEY)
    if size is None:
        assert isinstance(model, vae.ImageVAE)
        return
    latent = jax.ShapeDtypeStruct((4, 3), jnp.float32)
    assert eqx.filter_eval_shape(vae.StateVAE.decode, model, latent).shape == (4, size)
    assert [layer.weight.shape[1] for layer in model.encoder.layers] == [16, 8, 6]
    assert [layer.weight.shape[1] for layer in model.decoder.layers] == [8, 16, size]
