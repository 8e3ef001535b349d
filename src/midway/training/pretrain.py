"""What an agent learns from states of the environment before the first update."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from midway.agent import AgentState, Pretrain, PretrainSettings
from midway.errors import NonFiniteError
from midway.tables import Appender
from midway.training import seeds
from midway.training.arrays import load_arrays, networks_of, save_arrays
from midway.types import Observations, Subgoal, VectorGoalEnv

MakeEnv: TypeAlias = Callable[[int, str], VectorGoalEnv]
"""``(number of environments, task) -> vector environment``."""

Say: TypeAlias = Callable[[str], None]
Check: TypeAlias = Callable[[], None]
AnyPretrain: TypeAlias = Pretrain[Any, Any]

NUM_ENVS = 100
"""Environments that states are sampled from."""

MESSAGES = 10
"""Lines said on the way."""


def run(
    ability: AnyPretrain,
    state: AgentState,
    make_env: MakeEnv,
    seed: int,
    folder: Path,
    say: Say,
    check: Check = lambda: None,
) -> AgentState:
    """Return the agent's state after its pre-training.

    The networks are written to ``pretrained.safetensors``, the losses to ``pretraining.csv``.

    Args:
        ability: The agent's pre-training.
        state: The agent's state at its start.
        make_env: ``(number of environments, task) -> vector environment`` to sample states from.
        seed: Seed of the run.
        folder: The run folder.
        say: Is told how far it is.
        check: Is called after every step and round; what it raises ends the pre-training.

    Raises:
        ConfigurationError: Networks of another run shall be used and cannot be.
        NonFiniteError: A loss became NaN or infinite.
    """
    settings = ability.settings(state.config)
    if settings.source:
        state = load(state, settings.networks, Path(settings.source))
    else:
        env_seed, key = seeds.pretraining(seed)
        states = sample_states(make_env(NUM_ENVS, "uniform"), settings, env_seed, check)
        state = train(ability, state, states, key, folder, say, check)
    save_arrays(_file(folder), networks_of(state, settings.networks))
    return state


def sample_states(
    env: VectorGoalEnv, settings: PretrainSettings, seed: int, check: Check = lambda: None
) -> Subgoal:
    """Return states ``(N, ...)``: those of resets, and those after each of a few random actions.

    Args:
        env: A vector environment.
        settings: How many states and random actions.
        seed: Seed of resets and actions.
        check: Is called after every step.
    """
    generator = np.random.default_rng(seed)
    shape = (env.num_envs, env.goal_spec.action_dim)
    found: list[Observations] = [env.reset(seed=seed)[0]]
    while len(found) * env.num_envs < settings.states:
        for _ in range(settings.random_actions):
            actions = generator.uniform(-1, 1, shape).astype(np.float32)
            check()
            observation, _, terminated, truncated, _ = env.step(actions)
            found.append(observation)
            if (ended := terminated | truncated).any():
                env.reset(options={"reset_mask": ended})
        found.append(env.reset()[0])

    def all_of(name: str) -> Array:
        return jnp.asarray(np.concatenate([part[name] for part in found])[: settings.states])

    return Subgoal(all_of("observation"), all_of("achieved_goal"))


def train(
    ability: AnyPretrain,
    state: AgentState,
    states: Subgoal,
    key: Key[Array, ""],
    folder: Path,
    say: Say,
    check: Check = lambda: None,
) -> AgentState:
    """Return the agent's state after all rounds; each is one row of ``pretraining.csv``."""
    table = Appender(folder / "pretraining.csv", until=0)
    one_round = eqx.filter_jit(ability.round)
    rounds = ability.settings(state.config).rounds
    for number in range(1, rounds + 1):
        check()
        state, metrics = one_round(state, states, jax.random.fold_in(key, number))
        values = {name: float(value) for name, value in metrics.items()}
        for name, value in values.items():
            if not np.isfinite(value):
                raise NonFiniteError(f"{name} became {value} in round {number} of pre-training")
        table.write({"step": number, **values})
        if number * MESSAGES // rounds > (number - 1) * MESSAGES // rounds:
            described = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
            say(f"pre-training, round {number}/{rounds}  {described}")
    return state


def load(state: AgentState, networks: tuple[str, ...], run: Path) -> AgentState:
    """Return the agent's state with the pre-trained networks of a run.

    Raises:
        ConfigurationError: The run has none, or they are damaged or of other sizes.
    """
    arrays = load_arrays(_file(run), networks_of(state, networks))
    parts = [eqx.combine(arrays[name], getattr(state, name)) for name in networks]
    loaded: AgentState = eqx.tree_at(
        lambda s: [getattr(s, name) for name in networks], state, parts
    )
    return loaded


def _file(run: Path) -> Path:
    return run / "pretrained.safetensors"
