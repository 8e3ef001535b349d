"""A decoder of an image encoder's codes, fitted on the side for figures: the agent stays as it is.

It is fitted to images of the environment and to the codes that the encoder of a saved policy has
for them, and kept as ``decoder.safetensors`` in the run folder.
"""

import hashlib
from contextlib import suppress
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from midway.networks.decoder import ImageDecoder, loss
from midway.networks.encoder import ImageEncoder
from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.folder import RunFolder
from midway.training.policy import Policy
from midway.types import ConfigurationError

VERSION = 1
"""Counted up when the same policy would get another decoder."""

IMAGES = 4_000
COPIES = 50
"""Copies of the environment that images are taken from."""

ACTIONS = 2
"""Random actions after each reset, each of which gives an image too."""

UPDATES = 1_500
UPDATES_PER_CALL = 100
BATCH_SIZE = 32
LEARNING_RATE = 1.5e-3
"""Adam's rate at the start; it falls to 0 along a cosine."""

Fit: TypeAlias = tuple[ImageDecoder, optax.OptState]


def has_encoder(policy: Policy) -> bool:
    """Return whether the policy reads codes of images, made by an encoder of its own."""
    return isinstance(getattr(policy.state, "encoder", None), ImageEncoder)


def of_policy(folder: RunFolder, policy: Policy, env: Any) -> ImageDecoder:
    """Return the decoder of a run's policy: from its file, or fitted now and written to it.

    Args:
        folder: The run folder.
        policy: Its policy, with an image encoder.
        env: A vector environment of ``COPIES`` copies to take images from.
    """
    file = folder.path / "decoder.safetensors"
    key = {"policy": digest(policy), "step": str(policy.step)}
    # A file that is missing, damaged, or of another policy is made anew.
    with suppress(OSError, SafetensorError, ConfigurationError):
        with safe_open(file, "numpy") as stored:
            fits = stored.metadata() == key
        if fits:
            blank = ImageDecoder(code_size(policy), key=jax.random.key(0))
            arrays, static = eqx.partition(blank, eqx.is_array)
            loaded: ImageDecoder = eqx.combine(with_named_arrays(arrays, load_file(file)), static)
            return loaded
    decoder = fit(policy, env)
    arrays = {name: np.asarray(a) for name, a in named_arrays(_arrays(decoder)).items()}
    temporary = file.with_name(file.name + ".new")
    with suppress(OSError, SafetensorError):  # a folder that cannot be written has figures too
        save_file(arrays, temporary, metadata=key)
        temporary.replace(file)
    return decoder


def digest(policy: Policy) -> str:
    """Return what tells encoders and ways to fit a decoder apart."""
    found = hashlib.sha256(f"{VERSION} {policy.config.seed}".encode())
    for name, array in named_arrays(_arrays(policy.state.encoder)).items():
        found.update(name.encode() + np.asarray(array).tobytes())
    return found.hexdigest()[:16]


def fit(policy: Policy, env: Any) -> ImageDecoder:
    """Return a decoder fitted to the codes of a policy's encoder; the run's seed decides all."""
    # The seeds of training, evaluation and pre-training come from other hashes.
    env_seed, key_seed = np.random.SeedSequence((policy.config.seed, 3)).generate_state(2)
    images = jnp.asarray(sample_images(env, IMAGES, int(env_seed)))
    codes = eqx.filter_jit(lambda encoder, x: encoder(x))(policy.state.encoder, images)
    return fit_to(codes, images, jax.random.key(int(key_seed)), UPDATES)


def fit_to(
    codes: Float[Array, "N L"],
    images: UInt8[Array, "N 84 84 3"],
    key: Key[Array, ""],
    updates: int,
) -> ImageDecoder:
    """Return a decoder after so many steps of Adam on batches of these pairs."""
    decoder = ImageDecoder(codes.shape[-1], key=key).standardised(codes, images)
    fitted: Fit = decoder, _adam(updates).init(eqx.filter(decoder, eqx.is_inexact_array))
    for first in range(0, updates, UPDATES_PER_CALL):
        numbers = jnp.arange(first, min(first + UPDATES_PER_CALL, updates))
        fitted = _updates(fitted, codes, images, key, numbers, updates)
    return fitted[0]


@eqx.filter_jit
def _updates(fitted: Fit, codes: Any, images: Any, key: Any, numbers: Any, updates: int) -> Fit:
    """Return the decoder and its optimiser after the updates of these numbers."""
    arrays, static = eqx.partition(fitted, eqx.is_array)

    def one(arrays: Any, number: Any) -> tuple[Any, None]:
        decoder, state = eqx.combine(arrays, static)
        rows = jax.random.randint(jax.random.fold_in(key, number), (BATCH_SIZE,), 0, codes.shape[0])
        gradient = eqx.filter_grad(loss)(decoder, codes[rows], images[rows])
        changes, state = _adam(updates).update(gradient, state)
        return eqx.filter((eqx.apply_updates(decoder, changes), state), eqx.is_array), None

    arrays, _ = jax.lax.scan(one, arrays, numbers)
    result: Fit = eqx.combine(arrays, static)
    return result


def _adam(updates: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, updates))


def sample_images(env: Any, count: int, seed: int) -> UInt8[np.ndarray, "N 84 84 3"]:
    """Return images of starts, of goals, and of states after random actions.

    Args:
        env: A vector environment whose observations and goals are images.
        count: Number of images.
        seed: Seed of starts, goals and actions.
    """
    generator = np.random.default_rng(seed)
    observation = env.reset(seed=seed)[0]
    found: list[Any] = []
    while len(found) * env.num_envs < count:
        found += [observation["observation"], observation["desired_goal"]]
        for _ in range(ACTIONS):
            actions = generator.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            observation, _, terminated, truncated, _ = env.step(actions)
            found.append(observation["observation"])
            if (ended := terminated | truncated).any():
                env.reset(options={"reset_mask": ended})
        observation = env.reset()[0]
    return np.concatenate(found)[:count]


def code_size(policy: Policy) -> int:
    """Return the number of entries of a code."""
    shape = jax.eval_shape(
        policy.state.encoder, jnp.zeros((1, *policy.state.spec.observation_shape), jnp.uint8)
    ).shape
    return int(shape[-1])


def _arrays(module: eqx.Module) -> Any:
    return eqx.filter(module, eqx.is_array)
