"""The decoder of features, and how it is fitted."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.networks.decoder import ImageDecoder, loss
from midway.reports import decoder

KEY = jax.random.key(0)

# Compiled whole: operation by operation takes a gigabyte.
decoded = eqx.filter_jit(lambda decoder, features: decoder(features))
error, gradient_of = eqx.filter_jit(loss), eqx.filter_jit(eqx.filter_grad(loss))


def squares(count: int) -> tuple[jax.Array, jax.Array]:
    """Return images of a bright square, and features of its corner, far from standardised."""
    corners = np.random.default_rng(0).integers(0, 64, (count, 2))
    images = np.full((count, 84, 84, 3), 40, np.uint8)
    for image, (row, column) in zip(images, corners, strict=True):
        image[row : row + 20, column : column + 20, 0] = 240
    features = np.concatenate([1000 + corners, np.full((count, 1), 7.0)], 1).astype(np.float32)
    return jnp.asarray(features), jnp.asarray(images)


def test_a_new_decoder_gives_images_around_the_mean_image() -> None:
    features, images = squares(40)
    decoder = ImageDecoder(3, key=KEY).standardised(features, images)
    found = decoded(decoder, features)
    assert found.shape == (40, 84, 84, 3)
    mean = np.asarray(images, np.float64).mean(0) / 255
    assert np.abs(np.asarray(found) - mean).mean() < 0.1
    standard = (features - decoder.center) / decoder.scale
    np.testing.assert_allclose(standard.std(0), [1, 1, 0], atol=1e-3)


def test_what_the_images_say_of_themselves_is_not_trained() -> None:
    features, images = squares(4)
    decoder = ImageDecoder(3, key=KEY).standardised(features, images)
    gradient = gradient_of(decoder, features, images)
    for fixed in (gradient.center, gradient.scale, gradient.background):
        assert not fixed.any()
    assert gradient.hidden.layers[0].weight.any()


def test_the_loss_is_the_squared_error_of_an_image() -> None:
    features, images = squares(2)
    decoder = ImageDecoder(3, key=KEY)
    expected = ((np.asarray(images) / 255 - np.asarray(decoded(decoder, features))) ** 2).sum() / 2
    assert float(error(decoder, features, images)) == pytest.approx(expected, rel=1e-4)


def test_fitting_finds_the_images_of_new_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the features, the mean image leaves an error that most of must go."""
    # Hundreds of convolutions of whole images win back what optimising them takes.
    updates = eqx.filter_jit(
        inspect.unwrap(decoder._updates), compiler_options={"xla_backend_optimization_level": 3}
    )
    monkeypatch.setattr(decoder, "_updates", updates)
    features, images = squares(600)
    fitted = decoder.fit_to(features[:500], images[:500], KEY, updates=400)
    blank = ((images[500:] / 255 - fitted.background) ** 2).sum((1, 2, 3)).mean()
    assert float(error(fitted, features[500:], images[500:])) < 0.4 * float(blank)
