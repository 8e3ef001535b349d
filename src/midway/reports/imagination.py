"""What the networks of a saved policy imagine: subgoals between a state and a goal."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np

from midway.training.policy import Policy

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]


def imagines(policy: Policy) -> bool:
    """Return whether the agent has a policy over subgoals (RIS)."""
    return "subgoal_policy" in policy.agent.NETWORKS


def subgoals(policy: Policy, observation: Array, goal: Array, count: int, seed: int = 0) -> Array:
    """Return subgoals that the subgoal policy draws, as achieved goals ``(B, count, goal_dim)``.

    Args:
        policy: A policy that imagines.
        observation: States ``(B, ...)``.
        goal: Goals ``(B, ...)``.
        count: Draws for each pair.
        seed: Seed of the draws.
    """
    location, scale = _distribution(policy.state, observation, goal)
    noise = np.random.default_rng(seed).laplace(size=(len(location), count, location.shape[-1]))
    drawn = np.asarray(location)[:, None] + np.asarray(scale)[:, None] * noise
    return _achieved(policy, drawn)


def mean_subgoals(policy: Policy, observation: Array, goal: Array) -> Array:
    """Return the centre of the subgoal policy for each pair ``(B, goal_dim)``."""
    return _achieved(policy, np.asarray(_distribution(policy.state, observation, goal)[0]))


@eqx.filter_jit
def _distribution(state: Any, observation: Any, goal: Any) -> tuple[Any, Any]:
    subgoals = state.subgoal_policy(state.encoder(observation), state.encoder(goal))
    return subgoals.location, jax.numpy.exp(subgoals.log_scale)


def _achieved(policy: Policy, vector: Array) -> Array:
    """Return the part of predicted vectors that is an achieved goal."""
    return np.asarray(policy.agent.as_subgoal(policy.state.spec, vector).achieved_goal)
