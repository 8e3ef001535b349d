"""From observations to the codes that policies and critics read."""

from typing import Protocol, TypeAlias, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, Shaped, UInt8

from midway.networks.convolution import Filter, in_blocks
from midway.networks.initialization import with_centre_tap, with_orthogonal_weight
from midway.networks.mlp import Linear, Precision
from midway.types import Batch, ConfigurationError, EnvSpec

CODE_SIZE = 16
"""Numbers of an image's code (appendix B)."""

CHANNELS = 32
STRIDES = (2, 2, 2, 1)
"""Of the four 3 x 3 convolutions (appendix B)."""

SMALLEST_IMAGE = 31
"""Rows and columns that the convolutions make one pixel of."""


@runtime_checkable
class EncoderConfig(Protocol):
    """What an encoder needs of an agent's configuration."""

    @property
    def image_translation(self) -> int:
        """Largest random translation of an image along each axis (pixels)."""

    @property
    def image_pooling(self) -> int:
        """Side of the squares of pixels that are averaged before the convolutions."""

    @property
    def encoder_updates(self) -> int:
        """Updates after which the encoder stays as it is; 0 for never."""

    @property
    def precision(self) -> Precision:
        """Factors of products are rounded to it."""


class StateEncoder(eqx.Module):
    """States relative to the environment's origin, in its unit: the state itself in most."""

    origin: tuple[float, ...] = eqx.field(static=True)
    unit: float = eqx.field(static=True)

    def __call__(self, observation: Float[Array, "B S"]) -> Float[Array, "B S"]:
        """Return (state - origin) / unit."""
        return (observation - self._shift) / self.unit

    def states(self, code: Float[Array, "*B S"]) -> Float[Array, "*B S"]:
        """Return the states that codes stand for, in the units of the environment."""
        return code * self.unit + self._shift

    @property
    def _shift(self) -> Float[Array, "..."]:
        return jnp.asarray(self.origin) if self.origin else jnp.zeros(())

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
    translation: int = eqx.field(static=True)
    pooling: int = eqx.field(static=True)

    def __init__(
        self, image_shape: tuple[int, ...], config: EncoderConfig, *, key: Key[Array, ""]
    ) -> None:
        self.translation, self.pooling = config.image_translation, config.image_pooling
        keys = jax.random.split(key, len(STRIDES) + 1)
        height, width = (side // self.pooling for side in image_shape[:2])
        channels = image_shape[2]
        layers = []
        for stride, layer_key in zip(STRIDES, keys[:-1], strict=True):
            layer = Filter(3, stride, channels, CHANNELS, config.precision, key=layer_key)
            layers.append(with_centre_tap(layer, layer_key))
            height, width = (height - 3) // stride + 1, (width - 3) // stride + 1
            channels = CHANNELS
        linear = Linear(height * width * channels, CODE_SIZE, config.precision, key=keys[-1])
        self.convolutions = tuple(layers)
        self.linear = with_orthogonal_weight(linear, keys[-1])

    def __call__(
        self, image: UInt8[Array, "B H W 3"] | Float[Array, "B 16"]
    ) -> Float[Array, "B 16"]:
        """Return the codes of images; codes are returned as they are."""
        if is_code(image):
            return image

        def codes(image: UInt8[Array, "b H W 3"]) -> Float[Array, "b 16"]:
            x = pooled(image.astype(jnp.float32) / 255, self.pooling)
            for layer in self.convolutions:
                x = jax.nn.relu(layer.reduce(x))
            return self.linear(x.reshape(len(x), -1))

        found: Float[Array, "B 16"] = in_blocks(codes, image)
        return found

    def states(self, code: Float[Array, "*B 16"]) -> Float[Array, "*B 16"]:
        """Return the codes: they are not decoded here."""
        return code

    def augment(self, image: Shaped[Array, "B ..."], key: Key[Array, ""]) -> Shaped[Array, "B ..."]:
        """Return each image moved by offsets of its own, with a black rim (appendix B)."""
        if is_code(image):
            return image
        rim = self.translation
        framed = jnp.pad(image, ((0, 0), (rim, rim), (rim, rim), (0, 0)))
        corners = jax.random.randint(key, (len(image), 2), 0, 2 * rim + 1)

        def crop(framed: UInt8[Array, "..."], corner: Shaped[Array, "2"]) -> UInt8[Array, "..."]:
            return jax.lax.dynamic_slice(framed, (*corner, 0), image.shape[1:])

        moved: UInt8[Array, "B H W 3"] = jax.vmap(crop)(framed, corners)
        return moved


def pooled(image: Float[Array, "B H W C"], side: int) -> Float[Array, "B h w C"]:
    """Return the means of squares of pixels."""
    batch, height, width, channels = image.shape
    squares = image.reshape(batch, height // side, side, width // side, side, channels)
    return squares.mean((2, 4))


def is_code(image: Shaped[Array, "B ..."]) -> bool:
    """Return whether these are codes already, kept because their encoder learns no more."""
    return image.ndim == 2


Encoder: TypeAlias = StateEncoder | ImageEncoder


def create(spec: EnvSpec, config: EncoderConfig, key: Key[Array, ""]) -> Encoder:
    """Return the encoder that suits the environment's observations.

    Raises:
        ConfigurationError: A number below 0, or squares to average that do not tile images.
    """
    if spec.is_image:
        pooling = config.image_pooling
        for name in ("image_translation", "encoder_updates"):
            if getattr(config, name) < 0:
                raise ConfigurationError(f"{name} {getattr(config, name)}: must not be below 0")
        sides = spec.observation_shape[:2]
        if pooling < 1 or any(s % pooling or s // pooling < SMALLEST_IMAGE for s in sides):
            raise ConfigurationError(
                f"image_pooling {pooling}: must divide images of {sides[0]} x {sides[1]} pixels "
                f"and leave {SMALLEST_IMAGE}"
            )
        return ImageEncoder(spec.observation_shape, config, key=key)
    return StateEncoder(spec.origin, spec.unit)


def code_sizes(spec: EnvSpec) -> tuple[int, int]:
    """Return the sizes of an observation's and a goal's code."""
    if spec.is_image:
        return CODE_SIZE, CODE_SIZE
    return spec.observation_shape[0], spec.goal_shape[0]


def learns(
    encoder: Encoder,
    config: EncoderConfig,
    observation: Shaped[Array, "B ..."],
    updates: Int[Array, ""],
) -> bool | Bool[Array, ""]:
    """Return whether the encoder learns from these observations, after so many updates.

    That of states, which has nothing to learn, always does, and none learns from codes.
    """
    if config.encoder_updates == 0 or isinstance(encoder, StateEncoder):
        return True
    if is_code(observation):
        return False
    return updates < config.encoder_updates


def encode_fixed(
    encoder: Encoder, batch: Batch, learns: bool | Bool[Array, ""], key: Key[Array, ""]
) -> tuple[Shaped[Array, "B ..."], Batch]:
    """Return the augmented observations, and the batch with fixed codes of what follows them.

    Images are augmented while the encoder learns. Next observations and goals are encoded without
    gradient; only the current observation is left to be encoded within the critics' loss.
    """
    keys = jax.random.split(key, 3)

    def augmented(image: Shaped[Array, "B ..."], key: Key[Array, ""]) -> Shaped[Array, "B ..."]:
        return jnp.where(learns, encoder.augment(image, key), image)

    def code(image: Shaped[Array, "B ..."], key: Key[Array, ""]) -> Float[Array, "B S"]:
        return jax.lax.stop_gradient(encoder(augmented(image, key)))

    fixed = batch._replace(
        next_observation=code(batch.next_observation, keys[1]), goal=code(batch.goal, keys[2])
    )
    return augmented(batch.observation, keys[0]), fixed
