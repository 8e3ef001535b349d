"""From features of images back to images, for figures."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, Shaped

from midway.networks.convolution import Filter
from midway.networks.mlp import MLP
from midway.networks.vae import DECODER_LAYERS

SMALLEST_MAP = (2, 2, 64)
"""Rows, columns and channels that the transposed convolutions begin with."""

HIDDEN = (256,)

SMALLEST_DEVIATION = 1e-6
"""Features that vary less than this are centred, but not scaled."""


class ImageDecoder(eqx.Module):
    """Features ``(L,)`` to images ``(84, 84, 3)`` with values around [0, 1].

    It learns what differs from ``background``, the mean image; features are standardised by
    ``center`` and ``scale``.
    """

    hidden: MLP
    layers: tuple[Filter, ...]
    center: Float[Array, " L"]
    scale: Float[Array, " L"]
    background: Float[Array, "84 84 3"]

    def __init__(self, size: int, *, key: Key[Array, ""]) -> None:
        height, width, channels = SMALLEST_MAP
        hidden_key, *keys = jax.random.split(key, 1 + len(DECODER_LAYERS))
        self.hidden = MLP(size, HIDDEN, height * width * channels, "f32", key=hidden_key)
        inputs = (channels, *(out for _, _, out in DECODER_LAYERS))
        self.layers = tuple(
            Filter(kernel, stride, into, out, key=layer_key)
            for (kernel, stride, out), into, layer_key in zip(
                DECODER_LAYERS, inputs, keys, strict=False
            )
        )
        self.center = jnp.zeros(size)
        self.scale = jnp.ones(size)
        self.background = jnp.zeros((84, 84, 3))

    def __call__(self, features: Float[Array, "B L"]) -> Float[Array, "B 84 84 3"]:
        """Return the images that features stand for."""
        fixed = jax.lax.stop_gradient((self.center, self.scale, self.background))
        center, scale, background = fixed
        x = self.hidden((features - center) / scale).reshape(-1, *SMALLEST_MAP)
        for layer in self.layers:
            x = layer.enlarge(jax.nn.relu(x))
        return background + x

    def standardised(
        self, features: Float[Array, "N L"], images: Shaped[Array, "N 84 84 3"]
    ) -> "ImageDecoder":
        """Return the decoder with mean and deviation of these features, and the mean image."""
        deviation = features.std(0)
        scale = jnp.where(deviation < SMALLEST_DEVIATION, 1.0, deviation)
        background = images.mean(0, dtype=jnp.float32) / 255.0
        parts = (features.mean(0), scale, background)
        decoder: ImageDecoder = eqx.tree_at(
            lambda d: (d.center, d.scale, d.background), self, parts
        )
        return decoder


def loss(
    decoder: ImageDecoder, features: Float[Array, "B L"], images: Shaped[Array, "B 84 84 3"]
) -> Float[Array, ""]:
    """Return the squared error summed over the pixels, whose values are in [0, 1]; batch mean."""
    total: Float[Array, ""] = ((images / 255.0 - decoder(features)) ** 2).sum((1, 2, 3)).mean()
    return total
