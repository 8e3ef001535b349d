"""What the networks of a saved policy think: subgoals between a state and a goal, and values."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np

from midway.agents import registry
from midway.training.policy import Policy

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]


def imagines(agent: str) -> bool:
    """Return whether the agent of this name has a policy over subgoals (RIS)."""
    return "subgoal_policy" in registry.get(agent).NETWORKS


def plans(agent: str) -> bool:
    """Return whether the agent of this name plans subgoals as it acts (LEAP)."""
    return hasattr(registry.get(agent), "subgoal_codes")


def judges(agent: str) -> bool:
    """Return whether the agent of this name has a value of a state and a goal."""
    return hasattr(registry.get(agent), "value") or agent == "sac"


def plan(policy: Policy, memory: Any) -> Array | None:
    """Return the planned subgoals ``(B, N, G)`` of an agent that plans (LEAP), else None.

    Args:
        policy: The policy.
        memory: What it remembers of the running episodes.
    """
    if not plans(policy.config.agent):
        return None
    return np.asarray(_plan(policy.agent, policy.state, memory))


def first_plan(policy: Policy, observation: Array, goal: Array) -> Array:
    """Return the subgoals ``(N, G)`` planned between a state and a goal, as an episode begins.

    Args:
        policy: A policy that plans.
        observation: The state ``(...)``.
        goal: The goal ``(...)``.
    """
    actor = policy.actor()
    actor(observation[None], goal[None])
    found = plan(policy, actor.memory)
    assert found is not None
    return np.asarray(found[0])


@eqx.filter_jit
def _plan(agent: Any, state: Any, memory: Any) -> Any:
    return state.encoder.states(agent.subgoal_codes(state, memory.latents).achieved_goal)


def distribution(policy: Policy, observation: Array, goal: Array) -> tuple[Array, Array]:
    """Return location and scale of the subgoals for each pair, as achieved goals ``(B, G)``."""
    location, scale = _distribution(policy.state, observation, goal)
    return _achieved(policy, location), _achieved(policy, scale)


def subgoals(policy: Policy, observation: Array, goal: Array, count: int, seed: int = 0) -> Array:
    """Return subgoals that the subgoal policy draws, as achieved goals ``(B, count, G)``.

    All pairs share their noise: along an episode subgoals move and do not flicker.

    Args:
        policy: A policy that imagines.
        observation: States ``(B, ...)``.
        goal: Goals ``(B, ...)``.
        count: Draws for each pair.
        seed: Seed of the draws.
    """
    location, scale = distribution(policy, observation, goal)
    noise = np.random.default_rng(seed).laplace(size=(count, location.shape[-1]))
    return np.asarray(location[:, None] + scale[:, None] * noise)


def chain(policy: Policy, observation: Array, goal: Array, depth: int) -> Array:
    """Return the way from a state to a goal, imagined by halving it ``depth`` times.

    Args:
        policy: A policy that imagines.
        observation: The state ``(...)``.
        goal: The goal ``(...)``.
        depth: A chain of depth 1 is one subgoal; each further one imagines between the last.

    Returns:
        ``(2 ** depth - 1, G)`` achieved goals, from the state to the goal.
    """
    if depth == 0:
        return np.empty((0, *goal.shape))
    vector = _distribution(policy.state, observation[None], goal[None])[0]
    middle = policy.agent.as_subgoal(policy.state.spec, vector)
    reached, onwards = np.asarray(middle.achieved_goal), np.asarray(middle.observation)
    before = chain(policy, observation, reached[0], depth - 1)
    after = chain(policy, onwards[0], goal, depth - 1)
    return np.concatenate([before, reached, after])


def values(policy: Policy, observation: Array, goal: Array) -> Array:
    """Return the value of each pair ``(B,)``: the smaller Q of the mean action."""
    return np.asarray(_values(policy.agent, policy.state, observation, goal))


@eqx.filter_jit
def _distribution(state: Any, observation: Any, goal: Any) -> tuple[Any, Any]:
    subgoals = state.subgoal_policy(state.encoder(observation), state.encoder(goal))
    location = state.encoder.states(subgoals.location)
    return location, state.spec.unit * jax.numpy.exp(subgoals.log_scale)


@eqx.filter_jit
def _values(agent: Any, state: Any, observation: Any, goal: Any) -> Any:
    pair = state.encoder(observation), state.encoder(goal)
    if hasattr(agent, "value"):
        return agent.value(state, *pair)
    action = jax.numpy.tanh(state.policy(*pair).mean)
    return state.critic(pair[0], action, pair[1]).min(0)


def _achieved(policy: Policy, vector: Any) -> Array:
    """Return the part of predicted vectors that is an achieved goal."""
    return np.asarray(policy.agent.as_subgoal(policy.state.spec, vector).achieved_goal)
