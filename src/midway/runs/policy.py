"""Saved policies: weights and a description that others can load."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from midway import functional
from midway.agent import AgentState, AnyAgent, Encoder, Inputs, Memory, SubgoalDistribution
from midway.agents import registry
from midway.envs import own_spaces
from midway.errors import ConfigurationError
from midway.runs.folder import (
    FORMAT,
    RunConfig,
    RunFolder,
    check_format,
    read_json,
    write_json,
)
from midway.settings import changed
from midway.training import acting, freeze
from midway.training.acting import Seen
from midway.training.arrays import array_names, load_arrays, networks_of, said_of, save_arrays
from midway.training.evaluate import ActionKind, Evaluation
from midway.training.state import FROZEN, Training
from midway.training.step import create_state
from midway.types import AnyArray, EnvSpec, JsonObject, NumPyArray

Found = TypeVar("Found")


@dataclass(frozen=True)
class Policy:
    """A trained policy, ``policy(observation, goal) -> action``.

    Attributes:
        agent: The agent.
        state: The agent's state with the saved networks; its optimisers are at their start.
        config: The run that trained it.
        spec: The environment that it acts in.
        step: The environment step that it was saved at; None if its file does not say.
        encoder: The frozen encoder, where the agent reads features of images.
    """

    agent: AnyAgent
    state: AgentState
    config: RunConfig
    spec: EnvSpec
    step: int | None = None
    encoder: Encoder | None = None

    def using(self, changes: Mapping[str, object]) -> "Policy":
        """Return the policy with other values of settings that training did not depend on.

        Args:
            changes: Values by name, such as ``{"num_subgoals": 3}`` of LEAP; text is read as a
                Python literal.

        Raises:
            ConfigurationError: The agent has no such setting, or the value is not allowed.
        """
        if not changes:
            return self
        config = acting_settings(self.config, changes)
        state = dataclasses.replace(self.state, config=config.hyperparameters)
        return dataclasses.replace(self, state=state, config=config)

    def __call__(self, observation: AnyArray, goal: AnyArray) -> NumPyArray:
        """Return the deterministic action, ``(action_dim,)`` or ``(B, action_dim)``.

        Args:
            observation: One observation or a batch ``(B, ...)``.
            goal: One goal or a batch ``(B, ...)``.
        """
        observation, goal = np.asarray(observation), np.asarray(goal)
        single = observation.ndim == len(self.spec.observation_shape)
        if single:
            observation, goal = observation[None], goal[None]
        actions = self._act(observation, goal, jax.random.key(0), explore=False)
        return actions[0] if single else actions

    def sample(self, observation: Seen, goal: Seen, key: Key[Array, ""]) -> NumPyArray:
        """Return sampled actions ``(B, action_dim)`` for batches."""
        return self._act(observation, goal, key, explore=True)

    def predict(
        self,
        observation: Mapping[str, object],
        deterministic: bool = True,
        seed: int | None = None,
    ) -> NumPyArray:
        """Return the action for what the environment itself observes, as it takes actions.

        An agent that remembers its episode (TDM, LEAP) acts as in the first step of one; `actor`
        remembers.

        Args:
            observation: The environment's dictionary of ``observation``, ``achieved_goal`` and
                ``desired_goal``, or of batches of B of each.
            deterministic: Whether the action is the mean one, else a sampled one.
            seed: Seed of a sampled action; default: another draw on each call.

        Returns:
            One action, with shape, bounds and type of the environment's action space, or
            ``(B, ...)`` of them for batches.

        Raises:
            ConfigurationError: An entry is missing or has another shape, or the environment is not
                midway's and cannot be made here.
        """
        foreign = self.config.declaration().foreign
        states, goals, single = own_spaces.seen(self.spec, foreign, observation)
        drawn = np.random.SeedSequence(seed).generate_state(1)[0]
        actions = self._act(states, goals, jax.random.key(int(drawn)), explore=not deterministic)
        own = own_spaces.in_own_bounds(self.spec, foreign, actions)
        return own[0] if single else own

    def actor(self, actions: ActionKind = "mean", seed: int = 0) -> acting.Actor:
        """Return the policy as one that remembers its episodes, from their first step on.

        An agent that remembers nothing acts in the same way without. Others plan anew or start
        their time anew on each call where this is not used.

        Args:
            actions: ``mean`` (deterministic) or ``sampled``.
            seed: Seed of all draws.
        """
        explore = actions == "sampled"
        act = partial(_act_on, self.agent, self.encoder, self.state, explore=explore)
        begin = partial(acting.begin, self.agent, self.config.hyperparameters, self.state.spec)
        return acting.Actor(self.agent, act, begin, jax.random.key(seed))

    def features(self, observation: Seen) -> NumPyArray:
        """Return what the networks' state reads of observations or goals ``(B, ...)``."""
        return np.asarray(_features(self.encoder, observation))

    def value(self, observation: Seen, goal: Seen) -> NumPyArray:
        """Return the agent's value of each pair ``(B,)``; it must have one."""
        assert self.agent.value is not None
        estimate = self.agent.value.estimate
        return np.asarray(_on_features(estimate, self.encoder, self.state, observation, goal))

    def subgoals(self, observation: Seen, goal: Seen) -> SubgoalDistribution:
        """Return the subgoals imagined for each pair ``(B, ...)``; the agent must imagine any."""
        assert self.agent.subgoals is not None
        found = _on_features(self.agent.subgoals, self.encoder, self.state, observation, goal)
        in_numpy: SubgoalDistribution = jax.tree.map(np.asarray, found)
        return in_numpy

    def _act(self, observation: Seen, goal: Seen, key: Key[Array, ""], explore: bool) -> NumPyArray:
        pair = (observation, goal, key, explore)
        return np.asarray(_on_features(self.agent.act, self.encoder, self.state, *pair))


def _features(encoder: Encoder | None, observation: Seen) -> AnyArray:
    return observation if encoder is None else _encoded(encoder, observation)


def _read(encoder: Encoder | None, shown: Seen) -> Inputs:
    """Return what an agent reads of observations or goals, inside a compiled function."""
    array = jnp.asarray(shown)
    return array if encoder is None else encoder(array)


_encoded = eqx.filter_jit(_read)


@eqx.filter_jit
def _on_features(
    function: Callable[..., Found],
    encoder: Encoder | None,
    state: AgentState,
    observation: Seen,
    goal: Seen,
    *others: object,
) -> Found:
    pair = (_read(encoder, observation), _read(encoder, goal))
    return function(state, *pair, *others)


@eqx.filter_jit
def _act_on(
    agent: AnyAgent,
    encoder: Encoder | None,
    state: AgentState,
    memory: Memory,
    observation: Seen,
    goal: Seen,
    key: Key[Array, ""],
    *,
    explore: bool,
) -> tuple[Float[Array, "B A"], Memory]:
    pair = (_read(encoder, observation), _read(encoder, goal))
    return acting.act(agent, state, memory, *pair, key, explore=explore)


def acting_settings(config: RunConfig, changes: Mapping[str, object]) -> RunConfig:
    """Return the configuration with other values of settings that a trained policy may be given.

    Raises:
        ConfigurationError: The agent has no such setting, or the value is not allowed.
    """
    allowed = registry.get(config.agent).test_settings
    for name in changes:
        if name not in allowed:
            others = f"use one of {', '.join(allowed)}" if allowed else "it has none that may"
            raise ConfigurationError(
                f"setting {name!r} of {config.agent} may not change after training: {others}"
            )
    hyperparameters = changed(config.hyperparameters, changes)
    return dataclasses.replace(config, hyperparameters=hyperparameters)


def current(config: RunConfig, training: Training) -> Policy:
    """Return a copy of the policy of a run in memory, which outlives the next update."""
    state = functional.copy(training.state)
    step = training.counters.steps
    agent, spec = training.setup.agent, training.env_spec
    return Policy(agent, state, config, spec, step, training.encoder)


def save(folder: RunFolder, config: RunConfig, training: Training) -> None:
    """Write ``policy.safetensors`` and ``policy.json``, each whole or not at all."""
    _save_weights(folder.policy_weights, folder.identity(config), training)
    description = {
        "format": FORMAT,
        "step": training.counters.steps,
        "run": folder.identity(config),
        **config.to_json(),
        "spec": training.env_spec.to_json(),
    }
    write_json(folder.policy_config, description)


def keep(folder: RunFolder, config: RunConfig, training: Training) -> None:
    """Write a snapshot of the weights to ``policies/step-N.safetensors``."""
    folder.past_policies.mkdir(exist_ok=True)
    name = f"step-{training.counters.steps}.safetensors"
    _save_weights(folder.past_policies / name, folder.identity(config), training)


def keep_best(
    folder: RunFolder, config: RunConfig, training: Training, confirmed: Evaluation
) -> None:
    """Write the weights to ``policies/best.safetensors``, with what confirmed them."""
    folder.past_policies.mkdir(exist_ok=True)
    rate, episodes = confirmed.success_rate, len(confirmed.episodes)
    about = {"task": confirmed.task, "success_rate": rate, "episodes": episodes}
    _save_weights(folder.best_weights, folder.identity(config), training, **about)


def _save_weights(path: Path, run: str, training: Training, **about: object) -> None:
    networks = networks_of(training.state, training.setup.agent.networks)
    said = {"run": run, "step": training.counters.steps, **about}
    save_arrays(path, networks | _frozen(training.encoder), said)


def _frozen(encoder: Encoder | None) -> dict[str, PyTree]:
    """Return the arrays of a frozen encoder by their name in files; nothing without one."""
    return {} if encoder is None else {FROZEN: eqx.filter(encoder, eqx.is_array)}


def load(folder: RunFolder, weights: Path | None = None) -> Policy:
    """Return the policy of a run folder; no environment is made.

    Args:
        folder: The run folder.
        weights: Other weights than the newest: a file that `kept.weights_of` returned.

    Raises:
        ConfigurationError: The folder holds no policy, or a damaged one.
    """
    description, config, spec = described(folder)
    agent = registry.get(config.agent)
    newest = folder.policy_weights
    path, run = weights or newest, description.get("run")
    frozen = bool(agent.freezing) and any(name.startswith(FROZEN) for name in array_names(path))
    parts, features = expected(config, spec, frozen)
    arrays = load_arrays(path, parts, {"run": run} if run else None)
    key = jax.random.key(0)
    encoder = None
    if agent.freezing and frozen:
        whole = create_state(agent, config.hyperparameters, spec, key)
        encoder = eqx.combine(arrays.pop(FROZEN), agent.freezing.encoder(whole))
    # Made only where the file has the arrays: what describes it may ask for any amount of memory.
    state = create_state(agent, config.hyperparameters, features, key)
    loaded = {name: eqx.combine(arrays[name], getattr(state, name)) for name in arrays}
    state = dataclasses.replace(state, **loaded)
    step = (description if path == newest else said_of(path)).get("step")
    return Policy(agent, state, config, spec, step, encoder)


def expected(config: RunConfig, spec: EnvSpec, frozen: bool) -> tuple[dict[str, PyTree], EnvSpec]:
    """Return the shapes of a policy's arrays by part, and what its networks were made for.

    Raises:
        ConfigurationError: No networks can be made of these settings for this environment.
    """
    agent, key = registry.get(config.agent), jax.random.key(0)
    try:
        shapes = eqx.filter_eval_shape(agent.create, config.hyperparameters, spec, key)
        parts = {}
        if agent.freezing and frozen:
            encoder = agent.freezing.encoder(shapes)
            spec, parts[FROZEN] = freeze.encoded_spec(spec, encoder), eqx.filter(encoder, _is_shape)
            shapes = eqx.filter_eval_shape(agent.create, config.hyperparameters, spec, key)
    except Exception as error:  # whatever settings make of shapes that do not fit each other
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigurationError(
            f"{config.agent} for {spec.name} cannot be made: {reason}"
        ) from error
    networks = {name: eqx.filter(getattr(shapes, name), _is_shape) for name in agent.networks}
    return networks | parts, spec


def _is_shape(leaf: object) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def described(folder: RunFolder) -> tuple[JsonObject, RunConfig, EnvSpec]:
    """Return what ``policy.json`` holds, and the run and environment that it describes.

    Raises:
        ConfigurationError: It is missing, damaged, or of another run than the folder's.
    """
    path = folder.policy_config
    description = read_json(path)
    check_format(description, path)
    try:
        config = RunConfig.from_json(description)
        spec = EnvSpec.from_json({"task": None, **description.get("spec", {})})
    except (ConfigurationError, TypeError) as error:
        raise ConfigurationError(f"{path}: {error}") from error
    if folder.config_file.exists() and "run" in description:
        expected = folder.identity(folder.load_config())
        if description["run"] != expected:
            raise ConfigurationError(
                f"{path} is of another run: {description['run']!r} in {config.env!r}, "
                f"expected {expected!r}"
            )
    return description, config, spec
