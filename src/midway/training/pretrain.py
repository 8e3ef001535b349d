"""What an agent learns from states of the environment before the first update."""

import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.folder import RunFolder
from midway.training.logging import Table
from midway.training.progress import Reporter
from midway.types import ConfigurationError, NonFiniteError, Pretrained, Pretraining, Subgoal

COPIES = 100
"""Copies of the environment that states are sampled from."""

MESSAGES = 10
"""Lines said on the way."""


def run(
    agent: ModuleType,
    state: Any,
    make_env: Callable[[int, str], Any],
    seed: int,
    folder: RunFolder,
    say: Reporter,
) -> tuple[Any, float]:
    """Return the agent's state after its pre-training, if it has one, and the seconds it took.

    The networks are written to ``pretrained.safetensors``, the losses to ``pretraining.csv``.

    Args:
        agent: The agent's module.
        state: The agent's state at its start.
        make_env: ``(number of copies, task) -> vector environment`` to sample states from.
        seed: Seed of the run.
        folder: The run folder.
        say: Who is told how far it is.

    Raises:
        ConfigurationError: Networks of another run shall be used and cannot be.
        NonFiniteError: A loss became NaN or infinite.
    """
    if not isinstance(agent, Pretrained):
        return state, 0.0
    started = time.perf_counter()
    settings = agent.pretraining(state.config)
    if settings.source:
        state = load(state, settings.networks, Path(settings.source))
    else:
        # The seeds of training and of evaluation come from other hashes.
        env_seed, key_seed = np.random.SeedSequence((seed, 2)).generate_state(2)
        states = sample_states(make_env(COPIES, "uniform"), settings, int(env_seed))
        state = train(agent, state, states, settings, jax.random.key(int(key_seed)), folder, say)
    arrays = {name: np.asarray(x) for name, x in _arrays(state, settings.networks).items()}
    save_file(arrays, _file(folder.path))
    return state, time.perf_counter() - started


def sample_states(env: Any, settings: Pretraining, seed: int) -> Subgoal:
    """Return states ``(N, ...)``: those of resets, and those after each of a few random actions.

    Args:
        env: A vector environment.
        settings: How many states and random actions.
        seed: Seed of resets and actions.
    """
    generator = np.random.default_rng(seed)
    found: list[Any] = [env.reset(seed=seed)[0]]
    while len(found) * env.num_envs < settings.states:
        for _ in range(settings.random_actions):
            actions = generator.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            observation, _, terminated, truncated, _ = env.step(actions)
            found.append(observation)
            if (ended := terminated | truncated).any():
                env.reset(options={"reset_mask": ended})
        found.append(env.reset()[0])

    def all_of(name: str) -> Array:
        return jnp.asarray(np.concatenate([part[name] for part in found])[: settings.states])

    return Subgoal(all_of("observation"), all_of("achieved_goal"))


def train(
    agent: ModuleType,
    state: Any,
    states: Subgoal,
    settings: Pretraining,
    key: Any,
    folder: RunFolder,
    say: Reporter,
) -> Any:
    """Return the agent's state after all rounds; each is one row of ``pretraining.csv``."""
    table = Table(folder.path / "pretraining.csv", until=0)
    one_round = eqx.filter_jit(agent.pretrain)
    for number in range(1, settings.rounds + 1):
        state, metrics = one_round(state, states, jax.random.fold_in(key, number))
        values = {name: float(value) for name, value in metrics.items()}
        for name, value in values.items():
            if not np.isfinite(value):
                raise NonFiniteError(f"{name} became {value} in round {number} of pre-training")
        table.write({"step": number, **values})
        if number * MESSAGES // settings.rounds > (number - 1) * MESSAGES // settings.rounds:
            described = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
            say.message(f"pre-training, round {number}/{settings.rounds}  {described}")
    return state


def load(state: Any, networks: tuple[str, ...], run: Path) -> Any:
    """Return the agent's state with the pre-trained networks of a run.

    Raises:
        ConfigurationError: The run has none, or they are damaged or of other sizes.
    """
    try:
        arrays = load_file(_file(run))
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{_file(run)} cannot be read: {error}") from error
    parts = {name: getattr(state, name) for name in networks}
    dynamic, static = eqx.partition(parts, eqx.is_array)
    loaded = eqx.combine(with_named_arrays(dynamic, arrays), static)
    return eqx.tree_at(lambda s: [getattr(s, name) for name in networks], state, [*loaded.values()])


def _arrays(state: Any, networks: tuple[str, ...]) -> dict[str, Any]:
    parts = {name: getattr(state, name) for name in networks}
    return named_arrays(eqx.filter(parts, eqx.is_array))


def _file(run: Path) -> Path:
    return run / "pretrained.safetensors"
