"""Variational autoencoders of states and of images, in whose latent numbers LEAP plans.

Sizes are those of appendix D; losses those of the original LEAP implementation.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, Shaped

from midway.networks.convolution import BLOCK, Filter
from midway.networks.initialization import with_small_output
from midway.networks.mlp import MLP, Linear
from midway.types import EnvSpec, Metrics

SMALLEST_DEVIATION = 1e-3
"""Entries of a state that vary less than this are centred, but not scaled (original code)."""

SMALLEST_LOG_VARIANCE = float(jnp.log(1e-4))
"""Bound of the image encoder's log-variance (original code)."""

ENCODER_LAYERS = ((5, 3, 16), (5, 3, 16), (5, 3, 32))
"""Kernel, stride and output channels: 84 -> 27 -> 8 -> 2 pixels (appendix D)."""
DECODER_LAYERS = ((5, 3, 32), (6, 3, 16), (6, 3, 3))
"""The same for 2 -> 8 -> 27 -> 84 pixels; the appendix lists the input channels 32, 32, 16."""
SMALLEST_MAP = (2, 2, 32)


class Latent(NamedTuple):
    """A diagonal Gaussian over the latent numbers, q(z | x)."""

    mean: Float[Array, "*B L"]
    log_variance: Float[Array, "*B L"]

    def sample(self, noise: Float[Array, "*B L"]) -> Float[Array, "*B L"]:
        """Return mean + standard deviation * noise."""
        return self.mean + jnp.exp(0.5 * self.log_variance) * noise

    def kl(self) -> Float[Array, "*B"]:
        """Return D_KL(q(z | x) || N(0, 1)), summed over the latent numbers."""
        variance = jnp.exp(self.log_variance)
        return 0.5 * (self.mean**2 + variance - 1 - self.log_variance).sum(-1)


class StateVAE(eqx.Module):
    """Autoencoder of states ``(S,)``, which it standardises by ``center`` and ``scale``."""

    encoder: MLP
    decoder: MLP
    center: Float[Array, " S"]
    scale: Float[Array, " S"]

    def __init__(
        self, state_size: int, latent_size: int, hidden: tuple[int, ...], *, key: Key[Array, ""]
    ) -> None:
        encoder_key, decoder_key = jax.random.split(key)
        encoder = MLP(state_size, hidden, 2 * latent_size, "f32", key=encoder_key)
        decoder = MLP(latent_size, hidden[::-1], state_size, "f32", key=decoder_key)
        self.encoder = with_small_output(encoder, 1e-3)
        self.decoder = with_small_output(decoder, 1e-3)
        self.center = jnp.zeros(state_size)
        self.scale = jnp.ones(state_size)

    def encode(self, state: Float[Array, "*B S"]) -> Latent:
        """Return the distribution of the states' latent numbers."""
        center, scale = jax.lax.stop_gradient((self.center, self.scale))
        mean, log_variance = jnp.split(self.encoder((state - center) / scale), 2, axis=-1)
        return Latent(mean, log_variance)

    def decode(self, latent: Float[Array, "*B L"]) -> Float[Array, "*B S"]:
        """Return the states that the latent numbers stand for, in their own units."""
        center, scale = jax.lax.stop_gradient((self.center, self.scale))
        state: Float[Array, "*B S"] = self.decoder(latent) * scale + center
        return state

    def error(
        self, state: Float[Array, "B S"], reconstruction: Float[Array, "B S"]
    ) -> Float[Array, " B"]:
        """Return the mean squared error over the standardised entries."""
        scale = jax.lax.stop_gradient(self.scale)
        return (((state - reconstruction) / scale) ** 2).mean(-1)

    def standardised(self, states: Float[Array, "N S"]) -> "StateVAE":
        """Return the autoencoder with mean and deviation of these states."""
        deviation = states.std(0)
        scale = jnp.where(deviation < SMALLEST_DEVIATION, 1.0, deviation)
        parts = (states.mean(0), scale)
        vae: StateVAE = eqx.tree_at(lambda v: (v.center, v.scale), self, parts)
        return vae


class ImageVAE(eqx.Module):
    """Autoencoder of images ``(84, 84, 3)``, which it standardises by ``center`` and ``scale``.

    Reconstructions have values around [0, 1].
    """

    encoder: tuple[Filter, ...]
    to_latent: Linear
    from_latent: Linear
    decoder: tuple[Filter, ...]
    center: Float[Array, "84 84 3"]
    scale: Float[Array, ""]

    def __init__(self, latent_size: int, *, key: Key[Array, ""]) -> None:
        keys = iter(jax.random.split(key, 4))
        height, width, deepest = SMALLEST_MAP
        self.encoder = _stack(3, ENCODER_LAYERS, next(keys))
        self.to_latent = Linear(height * width * deepest, 2 * latent_size, "f32", key=next(keys))
        self.from_latent = Linear(latent_size, height * width * deepest, "f32", key=next(keys))
        self.decoder = _stack(deepest, DECODER_LAYERS, next(keys))
        self.center = jnp.zeros((84, 84, 3))
        self.scale = jnp.ones(())

    def encode(self, image: Shaped[Array, "B 84 84 3"]) -> Latent:
        """Return the distribution of the latent numbers of images, uint8 or in [0, 1]."""
        center, scale = jax.lax.stop_gradient((self.center, self.scale))
        x = ((image / 255.0 if image.dtype == jnp.uint8 else image) - center) / scale
        for layer in self.encoder:
            x = jax.nn.relu(layer.reduce(x))
        mean, raw = jnp.split(self.to_latent(x.reshape(len(x), -1)), 2, axis=-1)
        return Latent(mean, SMALLEST_LOG_VARIANCE + jnp.abs(raw))

    def decode(self, latent: Float[Array, "B L"]) -> Float[Array, "B 84 84 3"]:
        """Return the images that the latent numbers stand for."""
        center, scale = jax.lax.stop_gradient((self.center, self.scale))

        def one(latent: Float[Array, " L"]) -> Float[Array, "84 84 3"]:
            x = self.from_latent(latent[None]).reshape(1, *SMALLEST_MAP)
            for layer in self.decoder:
                x = layer.enlarge(jax.nn.relu(x))
            return x[0] * scale + center

        # In blocks that stay in the cache: half the time, of the gradient too.
        images: Float[Array, "B 84 84 3"] = jax.lax.map(one, latent, batch_size=BLOCK)
        return images

    def error(
        self, image: Shaped[Array, "B 84 84 3"], reconstruction: Float[Array, "B 84 84 3"]
    ) -> Float[Array, " B"]:
        """Return the squared error summed over the pixels, whose values are in [0, 1]."""
        return ((image / 255.0 - reconstruction) ** 2).sum((1, 2, 3))

    def standardised(self, states: Shaped[Array, "N 84 84 3"]) -> "ImageVAE":
        """Return the autoencoder with the mean of these images and one deviation for all pixels.

        What moves covers a few pixels, beside a background that the layers need not learn then.
        """
        center = states.mean(0, dtype=jnp.float32) / 255.0
        variance = (((states / 255.0) ** 2).mean(0) - center**2).mean()
        scale = jnp.sqrt(jnp.maximum(variance, SMALLEST_DEVIATION**2))
        vae: ImageVAE = eqx.tree_at(lambda v: (v.center, v.scale), self, (center, scale))
        return vae


class LatentMean(eqx.Module):
    """The encoder of images that an autoencoder holds: the means of their latent numbers."""

    vae: ImageVAE

    def __call__(self, image: Shaped[Array, "B 84 84 3"]) -> Float[Array, "B L"]:
        """Return the features of images."""
        return self.vae.encode(image).mean


def create(
    spec: EnvSpec, latent_size: int, hidden: tuple[int, ...], key: Key[Array, ""]
) -> StateVAE | ImageVAE:
    """Return the autoencoder that suits what a subgoal of the environment is.

    Where goals are not observations, a subgoal is both, and its state is their concatenation.
    """
    if spec.is_image or spec.image_shape:
        return ImageVAE(latent_size, key=key)
    size = spec.observation_shape[0] + (0 if spec.goal_is_observation else spec.goal_shape[0])
    return StateVAE(size, latent_size, hidden, key=key)


def loss(
    vae: StateVAE | ImageVAE,
    states: Shaped[Array, "B ..."],
    noise: Float[Array, "B L"],
    kl_weight: float,
) -> tuple[Float[Array, ""], Metrics]:
    """Return reconstruction error + kl_weight * D_KL(q(z | x) || N(0, 1)), batch means."""
    latent = vae.encode(states)
    error = vae.error(states, vae.decode(latent.sample(noise))).mean()
    kl = latent.kl().mean()
    total = error + kl_weight * kl
    return total, {"vae/loss": total, "vae/error": error, "vae/kl": kl}


def errors(vae: StateVAE | ImageVAE, spec: EnvSpec, states: Shaped[Array, "N ..."]) -> Metrics:
    """Return the mean error of reconstructed states, and for states that of their distance (m)."""
    reconstruction = vae.decode(vae.encode(states).mean)
    found = {"vae/held_out_error": vae.error(states, reconstruction).mean()}
    if not spec.is_image:
        goals = slice(-spec.goal_shape[0], None)
        distance = spec.task.distance(reconstruction[:, goals], states[:, goals])
        found["vae/held_out_distance"] = distance.mean()
    return found


def _stack(
    channels: int, layers: tuple[tuple[int, int, int], ...], key: Key[Array, ""]
) -> tuple[Filter, ...]:
    """Return layers given as kernel, stride and output channels."""
    inputs = (channels, *(out for _, _, out in layers[:-1]))
    keys = jax.random.split(key, len(layers))
    return tuple(
        Filter(kernel, stride, into, out, key=layer_key)
        for (kernel, stride, out), into, layer_key in zip(layers, inputs, keys, strict=True)
    )
