"""A decoder of an image encoder's features, fitted on the side for figures.

The agent stays as it is. The decoder is fitted to images of the environment and to the features
that the encoder of a saved policy makes of them; it is kept as ``decoder.safetensors`` in the run
folder.
"""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PyTree, Shaped, UInt8

from midway.agent import Encoder, PretrainSettings
from midway.errors import ConfigurationError
from midway.networks.decoder import ImageDecoder, loss
from midway.runs.folder import RunFolder
from midway.runs.policy import Policy
from midway.training import seeds
from midway.training.arrays import load_arrays, named_arrays, save_arrays
from midway.training.pretrain import sample_states
from midway.training.progress import stage
from midway.types import AnyArray, VectorGoalEnv

Result = TypeVar("Result")

VERSION = 2
"""Counted up when the same policy would get another decoder."""

IMAGES = 4_000
NUM_ENVS = 50
"""Environments that images are taken from."""

ACTIONS = 2
"""Random actions after each reset, each of which gives an image too."""

UPDATES = 1_500
UPDATES_PER_CALL = 100
BATCH_SIZE = 32
LEARNING_RATE = 1.5e-3
"""Adam's rate at the start; it falls to 0 along a cosine."""

Images: TypeAlias = Shaped[np.ndarray, "B H W 3"]
Fit: TypeAlias = tuple[ImageDecoder, optax.OptState]


def encoder_of(policy: Policy) -> Encoder | None:
    """Return what makes features of images: the frozen encoder, or the one still in the agent."""
    if policy.encoder is not None:
        return policy.encoder
    if policy.spec.is_image and policy.agent.freezing is not None:
        encoder: Encoder = policy.agent.freezing.encoder(policy.state)
        return encoder
    return None


def of_policy(folder: RunFolder, policy: Policy) -> ImageDecoder:
    """Return the decoder of a run's policy: from its file, or fitted now and written to it.

    Args:
        folder: The run folder.
        policy: Its policy, with an image encoder.

    Raises:
        ConfigurationError: Nothing here can draw the images that it is fitted to.
    """
    file = folder.path / "decoder.safetensors"
    encoder = encoder_of(policy)
    assert encoder is not None
    fitted_to = digest(policy, encoder)
    blank = ImageDecoder(feature_size(policy, encoder), key=jax.random.key(0))
    arrays, static = eqx.partition(blank, eqx.is_array)
    # A file that is missing, damaged, or of another policy is made anew.
    with suppress(ConfigurationError):
        stored = load_arrays(file, {"decoder": arrays, "fitted_to": fitted_to})
        if (np.asarray(stored["fitted_to"]) == fitted_to).all():
            loaded: ImageDecoder = eqx.combine(stored["decoder"], static)
            return loaded
    decoder = fit(policy, encoder)
    with suppress(OSError):  # a folder that cannot be written has figures too
        save_arrays(file, {"decoder": eqx.filter(decoder, eqx.is_array), "fitted_to": fitted_to})
    return decoder


def digest(policy: Policy, encoder: Encoder) -> UInt8[np.ndarray, " n"]:
    """Return what tells encoders, their steps and ways to fit a decoder apart."""
    found = hashlib.sha256(f"{VERSION} {policy.config.seed} {policy.step}".encode())
    for name, array in named_arrays(eqx.filter(encoder, eqx.is_array)).items():
        found.update(name.encode() + np.asarray(array).tobytes())
    return np.frombuffer(found.digest()[:16], np.uint8)


def fit(policy: Policy, encoder: Encoder) -> ImageDecoder:
    """Return a decoder fitted to the features of an encoder; the run's seed decides all."""
    images = jnp.asarray(real_images(policy))
    key = seeds.decoder(policy.config.seed)[1]
    return fit_to(_apply(encoder, images), images, key, UPDATES)


def real_images(policy: Policy) -> Images:
    """Return the images that a decoder is fitted to; the run's seed decides which."""
    env = policy.config.declaration().factory(num_envs=NUM_ENVS)
    return sample_images(env, IMAGES, seeds.decoder(policy.config.seed)[0])


def decoded(
    decoder: Callable[[Float[Array, "B F"]], Float[Array, "B H W 3"]],
    features: Float[AnyArray, "B F"],
) -> Images:
    """Return the images that features stand for, uint8."""
    return as_images(np.asarray(_apply(decoder, features)))


def reconstructed(policy: Policy, decoder: ImageDecoder, images: Images) -> Images:
    """Return what is left of images after encoding and decoding, uint8."""
    return decoded(decoder, features(policy, images))


def features(policy: Policy, images: Images) -> Float[np.ndarray, "B F"]:
    """Return what the policy's encoder makes of images."""
    encoder = encoder_of(policy)
    assert encoder is not None
    return np.asarray(_apply(encoder, images))


def as_images(values: Float[np.ndarray, "B H W 3"]) -> Images:
    """Return numbers around [0, 1] as uint8."""
    return np.asarray((255 * np.clip(values, 0, 1)).round(), np.uint8)


@eqx.filter_jit
def _apply(function: Callable[[Array], Result], x: AnyArray) -> Result:
    return function(jnp.asarray(x))


def fit_to(
    features: Float[Array, "N F"],
    images: UInt8[Array, "N 84 84 3"],
    key: Key[Array, ""],
    updates: int,
) -> ImageDecoder:
    """Return a decoder after so many steps of Adam on batches of these pairs."""
    decoder = ImageDecoder(features.shape[-1], key=key).standardised(features, images)
    fitted: Fit = decoder, _adam(updates).init(eqx.filter(decoder, eqx.is_inexact_array))
    for first in range(0, updates, UPDATES_PER_CALL):
        numbers = jnp.arange(first, min(first + UPDATES_PER_CALL, updates))
        stage("decoder for figures", first, updates)
        fitted = jax.block_until_ready(_updates(fitted, features, images, key, numbers, updates))
    return fitted[0]


@eqx.filter_jit
def _updates(
    fitted: Fit,
    features: Float[Array, "N F"],
    images: UInt8[Array, "N 84 84 3"],
    key: Key[Array, ""],
    numbers: Int[Array, " n"],
    updates: int,
) -> Fit:
    """Return the decoder and its optimiser after the updates of these numbers."""
    arrays, static = eqx.partition(fitted, eqx.is_array)

    def one(arrays: PyTree, number: Int[Array, ""]) -> tuple[PyTree, None]:
        decoder, state = eqx.combine(arrays, static)
        rows = jax.random.randint(
            jax.random.fold_in(key, number), (BATCH_SIZE,), 0, features.shape[0]
        )
        gradient = eqx.filter_grad(loss)(decoder, features[rows], images[rows])
        changes, state = _adam(updates).update(gradient, state)
        return eqx.filter((eqx.apply_updates(decoder, changes), state), eqx.is_array), None

    arrays, _ = jax.lax.scan(one, arrays, numbers)
    result: Fit = eqx.combine(arrays, static)
    return result


def _adam(updates: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, updates))


def sample_images(env: VectorGoalEnv, count: int, seed: int) -> UInt8[np.ndarray, "N 84 84 3"]:
    """Return images of states after resets and after random actions, and every fourth of a goal.

    Args:
        env: A vector environment whose observations and goals are images.
        count: Number of images.
        seed: Seed of starts, goals and actions.
    """
    settings = PretrainSettings((), count - count // 4, ACTIONS, rounds=0)
    states = np.asarray(sample_states(env, settings, seed).observation)
    resets = range(-(-(count // 4) // env.num_envs))
    goals = [env.reset()[0]["desired_goal"] for _ in resets]
    return np.concatenate([states, *goals])[:count]


def feature_size(policy: Policy, encoder: Encoder) -> int:
    """Return the number of features of an image."""
    image = jnp.zeros((1, *policy.spec.observation_shape), jnp.uint8)
    return int(jax.eval_shape(encoder, image).shape[-1])
