"""From observations to the codes that policies and critics read."""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, Shaped, UInt8

from midway.networks.convolution import Filter, in_blocks
from midway.networks.initialization import with_centre_tap, with_orthogonal_weight
from midway.networks.mlp import Linear, Precision
from midway.types import Batch, EnvSpec

CODE_SIZE = 16
"""Numbers of an image's code (appendix B)."""

CHANNELS = 32
STRIDES = (2, 2, 2, 1)
"""Of the four 3 x 3 convolutions (appendix B)."""

MARGIN = 8
"""Black pixels around an image before the random crop: 84 + 2 * 8 = 100 (appendix B)."""


class StateEncoder(eqx.Module):
    """The identity: a state is its own code."""

    def __call__(self, observation: Float[Array, "B S"]) -> Float[Array, "B S"]:
        """Return the observation."""
        return observation

    def augment(self, observation: Float[Array, "B S"], key: Key[Array, ""]) -> Float[Array, "B S"]:
        """Return the observation: states are not augmented."""
        return observation


class ImageEncoder(eqx.Module):
    """Four convolutions with ReLU and a linear layer: images ``(H, W, 3)`` to 16 numbers.

    Start as in the original code: convolutions orthogonal and zero but for the centre tap, the
    linear layer orthogonal, biases zero.
    """

    convolutions: tuple[Filter, ...]
    linear: Linear

    def __init__(
        self, image_shape: tuple[int, ...], precision: Precision, *, key: Key[Array, ""]
    ) -> None:
        keys = jax.random.split(key, len(STRIDES) + 1)
        height, width, channels = image_shape
        layers = []
        for stride, layer_key in zip(STRIDES, keys[:-1], strict=True):
            layer = Filter(3, stride, channels, CHANNELS, precision, key=layer_key)
            layers.append(with_centre_tap(layer, layer_key))
            height, width = (height - 3) // stride + 1, (width - 3) // stride + 1
            channels = CHANNELS
        linear = Linear(height * width * channels, CODE_SIZE, precision, key=keys[-1])
        self.convolutions = tuple(layers)
        self.linear = with_orthogonal_weight(linear, keys[-1])

    def __call__(self, image: UInt8[Array, "B H W 3"]) -> Float[Array, "B 16"]:
        """Return the codes of images."""

        def codes(image: UInt8[Array, "b H W 3"]) -> Float[Array, "b 16"]:
            x = image.astype(jnp.float32) / 255
            for layer in self.convolutions:
                x = jax.nn.relu(layer.reduce(x))
            return self.linear(x.reshape(len(x), -1))

        found: Float[Array, "B 16"] = in_blocks(codes, image)
        return found

    def augment(
        self, image: UInt8[Array, "B H W 3"], key: Key[Array, ""]
    ) -> UInt8[Array, "B H W 3"]:
        """Return each image moved by offsets of its own, up to 8 pixels, with a black rim."""
        framed = jnp.pad(image, ((0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)))
        corners = jax.random.randint(key, (len(image), 2), 0, 2 * MARGIN + 1)

        def crop(framed: UInt8[Array, "..."], corner: Shaped[Array, "2"]) -> UInt8[Array, "..."]:
            return jax.lax.dynamic_slice(framed, (*corner, 0), image.shape[1:])

        moved: UInt8[Array, "B H W 3"] = jax.vmap(crop)(framed, corners)
        return moved


Encoder: TypeAlias = StateEncoder | ImageEncoder


def create(spec: EnvSpec, precision: Precision, key: Key[Array, ""]) -> Encoder:
    """Return the encoder that suits the environment's observations."""
    if spec.is_image:
        return ImageEncoder(spec.observation_shape, precision, key=key)
    return StateEncoder()


def code_sizes(spec: EnvSpec) -> tuple[int, int]:
    """Return the sizes of an observation's and a goal's code."""
    if spec.is_image:
        return CODE_SIZE, CODE_SIZE
    return spec.observation_shape[0], spec.goal_shape[0]


def encode_fixed(
    encoder: Encoder, batch: Batch, key: Key[Array, ""]
) -> tuple[Shaped[Array, "B ..."], Batch]:
    """Return the augmented observations, and the batch with fixed codes of what follows them.

    Next observations and goals are augmented and encoded without gradient; only the current
    observation is left to be encoded within the critics' loss.
    """
    keys = jax.random.split(key, 3)

    def code(image: Shaped[Array, "B ..."], key: Key[Array, ""]) -> Float[Array, "B S"]:
        return jax.lax.stop_gradient(encoder(encoder.augment(image, key)))

    fixed = batch._replace(
        next_observation=code(batch.next_observation, keys[1]), goal=code(batch.goal, keys[2])
    )
    return encoder.augment(batch.observation, keys[0]), fixed
