"""The entropy coefficient c that SAC and CRL learn beside their policy (Haarnoja et al. 2018)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from midway.networks import optimizer
from midway.types import Metrics

State = TypeVar("State")


def loss(
    log_coefficient: Float[Array, ""], entropy: Float[Array, ""], target: float
) -> Float[Array, ""]:
    """Return log c times what the entropy exceeds its target by."""
    return log_coefficient * (jax.lax.stop_gradient(entropy) - target)


def step_policy_and_coefficient(
    policy_loss: Callable[..., tuple[Array, tuple[Array, Metrics]]],
    state: State,
    target: float,
    *inputs: object,
) -> tuple[State, Metrics]:
    """Return the agent's state after one step of the policy, then of c towards the target entropy.

    Args:
        policy_loss: A function of the policy, the state and the inputs: its value, the entropy and
            metrics.
        state: A state with both, their optimisers and rates.
        target: Entropy that the policy should have.
        inputs: Of the loss.
    """
    agent: Any = state
    rates = agent.config
    policy, policy_optimizer, (entropy, metrics) = optimizer.minimise(
        policy_loss,
        agent.policy,
        agent.policy_optimizer,
        optimizer.decayed(rates.policy_learning_rate, rates, agent.policy_optimizer),
        state,
        *inputs,
    )
    log_coefficient, entropy_optimizer = optimizer.step(
        agent.log_entropy_coefficient,
        jax.grad(loss)(agent.log_entropy_coefficient, entropy, target),
        agent.entropy_optimizer,
        rates.entropy_learning_rate,
    )
    state = replace(
        agent,
        policy=policy,
        policy_optimizer=policy_optimizer,
        log_entropy_coefficient=log_coefficient,
        entropy_optimizer=entropy_optimizer,
    )
    return state, metrics | {"policy/entropy_coefficient": jnp.exp(log_coefficient)}
