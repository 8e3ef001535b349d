"""From observations to the features that policies and critics read."""

import math
from collections.abc import Callable
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, Shaped, UInt8

from midway.errors import ConfigurationError
from midway.networks.convolution import Filter, in_blocks
from midway.networks.initialization import with_centre_tap, with_orthogonal_weight
from midway.networks.mlp import Linear, Precision
from midway.types import Batch, EnvSpec, Subgoal

NUM_FEATURES = 16
"""Features of an image (appendix D)."""

LARGEST_FEATURE = 5.0
"""Bound of normalised entries: an ant on its back lies 20 deviations off."""

T = TypeVar("T")

CHANNELS = 32
STRIDES = (2, 2, 2, 1)
"""Of the four 3 x 3 convolutions (appendix D)."""

SMALLEST_IMAGE = 31
"""Rows and columns that the convolutions make one pixel of."""


@runtime_checkable
class EncoderConfig(Protocol):
    """What an encoder needs of an agent's configuration."""

    @property
    def random_shift(self) -> int:
        """Largest random shift of an image along each axis (pixels)."""

    @property
    def image_pooling(self) -> int:
        """Side of the squares of pixels that are averaged before the convolutions."""

    @property
    def normalise(self) -> bool:
        """Whether states are read relative to their typical middle and deviation."""

    @property
    def precision(self) -> Precision:
        """Inputs of matrix products are rounded to it."""


class StateEncoder(eqx.Module):
    """States relative to the environment's origin, in its unit: the state itself in most.

    Attributes:
        origin: Middle of the states; nothing for zeros.
        unit: What one unit of the features is, for all entries or for each.
        bound: Largest feature.
        goal_coordinates: Entries of a state that make a goal, where goals are not states; both are
            told apart by their length.
    """

    origin: tuple[float, ...] = eqx.field(static=True)
    unit: float | tuple[float, ...] = eqx.field(static=True)
    bound: float = eqx.field(static=True, default=math.inf)
    goal_coordinates: tuple[int, ...] = eqx.field(static=True, default=())

    def __call__(self, observation: Float[Array, "*B S"]) -> Float[Array, "*B S"]:
        """Return (state - origin) / unit, within ± bound."""
        shift, unit = self._of(observation.shape[-1])
        features = (observation - shift) / unit
        return features if math.isinf(self.bound) else jnp.clip(features, -self.bound, self.bound)

    def states(self, features: Float[Array, "*B S"]) -> Float[Array, "*B S"]:
        """Return the states that features stand for, in the units of the environment."""
        shift, unit = self._of(features.shape[-1])
        return features * unit + shift

    def spread(self, scale: Float[Array, "*B S"]) -> Float[Array, "*B S"]:
        """Return scales of features in the units of the environment."""
        return scale * self._of(scale.shape[-1])[1]

    def _of(self, size: int) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return origin and unit of states or goals of this length."""
        shift = jnp.asarray(self.origin) if self.origin else jnp.zeros(())
        unit = jnp.asarray(self.unit)
        if self.goal_coordinates and size == len(self.goal_coordinates):
            index = jnp.asarray(self.goal_coordinates)
            shift, unit = (x[index] if x.ndim else x for x in (shift, unit))
        return shift, unit

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
    random_shift: int = eqx.field(static=True)
    pooling: int = eqx.field(static=True)

    def __init__(
        self, image_shape: tuple[int, ...], config: EncoderConfig, *, key: Key[Array, ""]
    ) -> None:
        self.random_shift, self.pooling = config.random_shift, config.image_pooling
        keys = jax.random.split(key, len(STRIDES) + 1)
        height, width = (side // self.pooling for side in image_shape[:2])
        channels = image_shape[2]
        layers = []
        for stride, layer_key in zip(STRIDES, keys[:-1], strict=True):
            layer = Filter(3, stride, channels, CHANNELS, config.precision, key=layer_key)
            layers.append(with_centre_tap(layer, layer_key))
            height, width = (height - 3) // stride + 1, (width - 3) // stride + 1
            channels = CHANNELS
        linear = Linear(height * width * channels, NUM_FEATURES, config.precision, key=keys[-1])
        self.convolutions = tuple(layers)
        self.linear = with_orthogonal_weight(linear, keys[-1])

    def __call__(self, image: UInt8[Array, "B H W 3"]) -> Float[Array, "B 16"]:
        """Return the features of images."""

        def features(image: UInt8[Array, "b H W 3"]) -> Float[Array, "b 16"]:
            x = pooled(image.astype(jnp.float32) / 255, self.pooling)
            for layer in self.convolutions:
                x = jax.nn.relu(layer.reduce(x))
            return self.linear(x.reshape(len(x), -1))

        found: Float[Array, "B 16"] = in_blocks(features, image)
        return found

    def states(self, features: Float[Array, "*B 16"]) -> Float[Array, "*B 16"]:
        """Return the features: they are not decoded here."""
        return features

    def spread(self, scale: Float[Array, "*B 16"]) -> Float[Array, "*B 16"]:
        """Return the scales of features as they are."""
        return scale

    def augment(
        self, image: UInt8[Array, "B H W 3"], key: Key[Array, ""]
    ) -> UInt8[Array, "B H W 3"]:
        """Return each image shifted by random offsets of its own, on black (appendix B)."""
        rim = self.random_shift
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


Encoder: TypeAlias = StateEncoder | ImageEncoder


def create(spec: EnvSpec, config: EncoderConfig, key: Key[Array, ""]) -> Encoder:
    """Return the encoder that suits the environment's observations.

    Raises:
        ConfigurationError: The squares to average do not tile images.
    """
    if spec.is_image:
        pooling = config.image_pooling
        sides = spec.observation_shape[:2]
        if pooling < 1 or any(s % pooling or s // pooling < SMALLEST_IMAGE for s in sides):
            raise ConfigurationError(
                f"image_pooling {pooling}: must divide images of {sides[0]} x {sides[1]} pixels "
                f"and leave {SMALLEST_IMAGE}"
            )
        return ImageEncoder(spec.observation_shape, config, key=key)
    if config.normalise and spec.spread:
        return StateEncoder(spec.center, spec.spread, LARGEST_FEATURE, spec.goal_coordinates)
    return StateEncoder(spec.origin, spec.unit)


def feature_sizes(spec: EnvSpec) -> tuple[int, int]:
    """Return the numbers of features of an observation and of a goal."""
    if spec.is_image:
        return NUM_FEATURES, NUM_FEATURES
    return spec.observation_shape[0], spec.goal_shape[0]


def scale(encoder: Encoder, entry: int = 0) -> float:
    """Return how many of the environment's units one unit of a feature is."""
    unit = getattr(encoder, "unit", 1.0)
    return float(unit[entry] if isinstance(unit, tuple) else unit)


def subgoal_size(spec: EnvSpec) -> int:
    """Return the length of a subgoal as one vector: of both roles where both are needed."""
    observation, goal = feature_sizes(spec)
    return observation if _state_tells(spec) else observation + goal


def _state_tells(spec: EnvSpec) -> bool:
    """Return whether the state of a subgoal tells the goal that it is reached as."""
    return spec.goal_is_observation or bool(spec.goal_coordinates)


def as_subgoal(spec: EnvSpec, vector: Float[Array, "*B S"]) -> Subgoal:
    """Split a vector into the state it is started from and the goal it is reached as."""
    if spec.goal_is_observation:
        return Subgoal(vector, vector)
    if spec.goal_coordinates:
        return Subgoal(vector, vector[..., jnp.asarray(spec.goal_coordinates)])
    size = feature_sizes(spec)[0]
    return Subgoal(vector[..., :size], vector[..., size:])


def as_vector(spec: EnvSpec, subgoal: Subgoal) -> Shaped[Array, "*B S"]:
    """Join both roles of a subgoal into one vector."""
    if _state_tells(spec):
        return subgoal.observation
    return jnp.concatenate(subgoal, axis=-1)


def encode_batch(
    encoder: Encoder, batch: Batch, key: Key[Array, ""]
) -> tuple[Shaped[Array, "B ..."], Batch]:
    """Return the augmented observations, and the batch with features of what follows them.

    Next observations and goals are encoded without gradient; only the current observation is left
    to be encoded within the critics' loss (appendix B, vision based environments).
    """
    keys = jax.random.split(key, 3)

    def features(image: Shaped[Array, "B ..."], key: Key[Array, ""]) -> Float[Array, "B S"]:
        return jax.lax.stop_gradient(encoder(encoder.augment(image, key)))

    encoded = batch._replace(
        next_observation=features(batch.next_observation, keys[1]),
        goal=features(batch.goal, keys[2]),
    )
    return encoder.augment(batch.observation, keys[0]), encoded


@runtime_checkable
class Sees(Protocol):
    """An agent's state with an encoder of its own."""

    @property
    def encoder(self) -> Encoder:
        """The encoder."""


def candidates(encoder: Encoder, batch: Batch, features: Float[Array, "B S"]) -> Subgoal:
    """Return the features of the states drawn from replay as subgoal candidates (p_s of eq. 17).

    For images these are the features of the batch's own observations, each beside another
    transition: as uniform as any draws, and no further pass through the encoder.
    """
    if isinstance(encoder, StateEncoder):
        return Subgoal(*map(encoder, batch.subgoal_candidate))
    shifted = jnp.roll(features, 1, axis=0)
    return Subgoal(shifted, shifted)


def on_observations(function: Callable[..., T]) -> Callable[..., T]:
    """Return a function of (state, features, features) as one of what the environment shows."""

    def read(
        state: Sees,
        observation: Shaped[Array, "B ..."],
        goal: Shaped[Array, "B ..."],
        *others: object,
    ) -> T:
        return function(state, state.encoder(observation), state.encoder(goal), *others)

    return read
