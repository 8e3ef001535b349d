"""Saved policies: weights and a description that others can load."""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from midway.agents import registry
from midway.training import acting
from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.evaluate import ActionKind
from midway.training.folder import FORMAT, RunConfig, RunFolder, read_json, write_json
from midway.training.step import create_state
from midway.types import ConfigurationError, EnvSpec


@dataclass(frozen=True)
class Policy:
    """A trained policy, ``policy(observation, goal) -> action``.

    Attributes:
        agent: The agent's module.
        state: The agent's state with the saved networks; its optimisers are at their start.
        config: The run that trained it.
        step: The environment step that it was saved at; None if its file does not say.
    """

    agent: ModuleType
    state: Any
    config: RunConfig
    step: int | None = None

    def __call__(self, observation: Any, goal: Any) -> np.ndarray[Any, np.dtype[Any]]:
        """Return the tanh of the mean action, ``(action_dim,)`` or ``(B, action_dim)``.

        Args:
            observation: One observation or a batch ``(B, ...)``.
            goal: One goal or a batch ``(B, ...)``.
        """
        observation, goal = np.asarray(observation), np.asarray(goal)
        single = observation.ndim == len(self.state.spec.observation_shape)
        if single:
            observation, goal = observation[None], goal[None]
        actions = np.asarray(_mean_action(self.agent, self.state, observation, goal))
        return actions[0] if single else actions

    def sample(self, observation: Any, goal: Any, key: Any) -> np.ndarray[Any, np.dtype[Any]]:
        """Return sampled actions ``(B, action_dim)`` for batches."""
        return np.asarray(_sampled_action(self.agent, self.state, observation, goal, key))

    def actor(self, actions: ActionKind = "mean", seed: int = 0) -> acting.Actor:
        """Return the policy as one that remembers its episodes, from their first step on.

        An agent that remembers nothing acts in the same way without. Others plan anew or start
        their time anew on each call where this is not used.

        Args:
            actions: ``mean`` or ``sampled``.
            seed: Seed of all draws.
        """
        act = partial(_act, self.agent, self.state, explore=actions == "sampled")
        begin = partial(acting.begin, self.agent, self.config.hyperparameters, self.state.spec)
        return acting.Actor(act, begin, jax.random.key(seed))


_act = eqx.filter_jit(acting.act)


@eqx.filter_jit
def _mean_action(agent: ModuleType, state: Any, observation: Any, goal: Any) -> Any:
    return agent.act(state, observation, goal, jax.random.key(0), False)


@eqx.filter_jit
def _sampled_action(agent: ModuleType, state: Any, observation: Any, goal: Any, key: Any) -> Any:
    return agent.act(state, observation, goal, key, True)


def _networks(agent: ModuleType, state: Any) -> dict[str, Any]:
    return {name: eqx.filter(getattr(state, name), eqx.is_array) for name in agent.NETWORKS}


def save(folder: RunFolder, config: RunConfig, state: Any, steps: int) -> None:
    """Write ``policy.safetensors`` and ``policy.json``, each whole or not at all."""
    _save_weights(folder.policy_weights, config, state)
    spec = dataclasses.asdict(state.spec)
    del spec["task"]
    description = {"format": FORMAT, "step": steps, **config.to_json(), "spec": spec}
    write_json(folder.policy_config, description)


def keep(folder: RunFolder, config: RunConfig, state: Any, steps: int) -> None:
    """Write the weights of this moment of training to ``policies/step-N.safetensors``."""
    folder.past_policies.mkdir(exist_ok=True)
    _save_weights(folder.past_policies / f"step-{steps}.safetensors", config, state)


def _save_weights(path: Path, config: RunConfig, state: Any) -> None:
    networks = _networks(registry.get(config.agent), state)
    arrays = {name: np.asarray(array) for name, array in named_arrays(networks).items()}
    temporary = path.with_name(path.name + ".new")
    try:
        save_file(arrays, temporary)
    except SafetensorError as error:
        raise OSError(f"{path} cannot be written: {error}") from error
    temporary.replace(path)


def load(folder: RunFolder, spec: EnvSpec) -> Policy:
    """Return the policy of a run folder, for an environment of the same shapes.

    Raises:
        ConfigurationError: The folder holds no policy, or a damaged or foreign one.
    """
    description = read_json(folder.policy_config)
    config = RunConfig.from_json(description)
    agent = registry.get(config.agent)
    state = create_state(agent, config.hyperparameters, spec, jax.random.key(0))
    try:
        arrays = load_file(folder.policy_weights)
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{folder.policy_weights} cannot be read: {error}") from error
    networks = with_named_arrays(_networks(agent, state), arrays)
    loaded = {name: eqx.combine(networks[name], getattr(state, name)) for name in networks}
    step = description.get("step")
    return Policy(agent, dataclasses.replace(state, **loaded), config, step)
