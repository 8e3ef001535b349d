"""Every stream of random numbers of a run, from its one seed."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key

PRETRAINING, EVALUATION, DECODER = 2, 1, 3
"""What tells these streams apart from each other and from those of training."""

EVALUATED, CONFIRMED = 0, 1
"""What tells the episodes of an evaluation apart from those that confirm the best policy."""


class Streams(NamedTuple):
    """Seeds and keys of a training run; further draws fold a counter of steps or updates in.

    Attributes:
        env: Seed of the environments that data are collected in.
        evaluation: Seed of the environments of its evaluations; see `episodes`.
        action: Seed of the uniform random actions.
        network_key: Of the networks' initial weights.
        update_key: Of the updates.
        act_key: Of sampled actions.
        evaluation_key: Of sampled actions in evaluations.
    """

    env: int
    evaluation: int
    action: int
    network_key: Key[Array, ""]
    update_key: Key[Array, ""]
    act_key: Key[Array, ""]
    evaluation_key: Key[Array, ""]

    def episodes(self, step: int, use: int = EVALUATED) -> int:
        """Return the seed of the episodes of one evaluation: others at each step, for each use."""
        return int(np.random.SeedSequence((self.evaluation, step, use)).generate_state(1)[0])


def training(seed: int) -> Streams:
    """Return the streams of a training run."""
    env, evaluation, action, key = np.random.SeedSequence(seed).generate_state(4)
    keys = jax.random.split(jax.random.key(int(key)), 4)
    return Streams(int(env), int(evaluation), int(action), *keys)


def pretraining(seed: int) -> tuple[int, Key[Array, ""]]:
    """Return the seed of the states that are pre-trained on, and the key of its updates."""
    return _env_and_key(seed, PRETRAINING)


def decoder(seed: int) -> tuple[int, Key[Array, ""]]:
    """Return the seed of the images that a decoder is fitted to, and the key of its updates."""
    return _env_and_key(seed, DECODER)


def evaluation(seed: int) -> int:
    """Return the seed of the environments of `midway evaluate`, which no training meets."""
    return int(np.random.SeedSequence((seed, EVALUATION)).generate_state(1)[0])


def _env_and_key(seed: int, stream: int) -> tuple[int, Key[Array, ""]]:
    env, key = np.random.SeedSequence((seed, stream)).generate_state(2)
    return int(env), jax.random.key(int(key))
