"""One Adam per network: the paper has a learning rate for each (table 1)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import equinox as eqx
import optax
from jaxtyping import Array, Float, Int, PyTree

Network = TypeVar("Network", bound=PyTree)
State = TypeVar("State")
Others = TypeVar("Others")
Rate: TypeAlias = float | Float[Array, ""]
"""A learning rate: fixed, or decayed."""


@runtime_checkable
class Decaying(Protocol):
    """Settings of an agent whose learning rates may decay."""

    @property
    def halve_rates_after(self) -> int:
        """N of `decayed`."""


def init(network: PyTree) -> optax.OptState:
    """Return Adam's state at the start for every array of the network."""
    return optax.adam(0.0).init(eqx.filter(network, eqx.is_inexact_array))


def step(
    network: Network, gradient: PyTree, state: optax.OptState, learning_rate: Rate
) -> tuple[Network, optax.OptState]:
    """Return the network after one step of Adam against the gradient, and Adam's new state."""
    updates, state = optax.adam(learning_rate).update(gradient, state)
    return eqx.apply_updates(network, updates), state


def minimise(
    loss: Callable[..., tuple[Array, Others]],
    network: Network,
    state: optax.OptState,
    learning_rate: Rate,
    *inputs: object,
) -> tuple[Network, optax.OptState, Others]:
    """Return the network after one step of Adam, Adam's new state, and what else the loss gives."""
    gradient_of = eqx.filter_value_and_grad(loss, has_aux=True)
    (_, others), gradient = gradient_of(network, *inputs)
    return *step(network, gradient, state, learning_rate), others


def step_critic_and_encoder(
    loss: Callable[..., tuple[Array, Others]], state: State, *inputs: object
) -> tuple[State, Others]:
    """Return the agent's state after one step of critics and encoder, and what else the loss gives.

    Args:
        loss: A function of (critics, encoder) and the inputs: its value, and anything else.
        state: A state with both networks, their optimisers and rates.
        inputs: Of the loss.
    """
    agent: Any = state
    gradient_of = eqx.filter_value_and_grad(loss, has_aux=True)
    (_, others), gradients = gradient_of((agent.critic, agent.encoder), *inputs)
    config, adam = agent.config, (agent.critic_optimizer, agent.encoder_optimizer)
    rate = decayed(config.critic_learning_rate, config, adam[0])
    critic = step(agent.critic, gradients[0], adam[0], rate)
    encoder = step(agent.encoder, gradients[1], adam[1], config.encoder_learning_rate)
    return replace(
        agent,
        critic=critic[0],
        critic_optimizer=critic[1],
        encoder=encoder[0],
        encoder_optimizer=encoder[1],
    ), others


def decayed(rate: float, config: object, state: optax.OptState) -> Rate:
    """Return η / (1 + t / N) after t updates of a network: inverse-time decay.

    Args:
        rate: η, the rate of the first update.
        config: The agent's settings, with N; the rate stays what it is with N = 0 or without N.
        state: The network's Adam, which counts t.
    """
    if not isinstance(config, Decaying) or config.halve_rates_after == 0:
        return rate
    return rate / (1 + updates(state) / config.halve_rates_after)


def updates(state: optax.OptState) -> Int[Array, ""]:
    """Return how many steps were taken."""
    count: Int[Array, ""] = optax.tree_utils.tree_get(state, "count")
    return count
