"""One Adam per network: the paper has a learning rate for each (table 1)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, PyTree

Network = TypeVar("Network", bound=PyTree)
State = TypeVar("State")


def init(network: PyTree) -> optax.OptState:
    """Return Adam's state at the start for every array of the network."""
    return optax.adam(0.0).init(eqx.filter(network, eqx.is_inexact_array))


def step(
    network: Network, gradient: PyTree, state: optax.OptState, learning_rate: float
) -> tuple[Network, optax.OptState]:
    """Return the network after one step of Adam against the gradient, and Adam's new state."""
    updates, state = optax.adam(learning_rate).update(gradient, state)
    return eqx.apply_updates(network, updates), state


def step_critic_and_encoder(
    loss: Callable[..., Any], state: State, learns: bool | Bool[Array, ""], *inputs: Any
) -> tuple[State, Any]:
    """Return the agent's state after one step of critics and encoder, and what else the loss gives.

    Args:
        loss: A function of (critics, encoder) and the inputs: its value, and anything else.
        state: A state with both networks, their optimisers and rates.
        learns: Whether the encoder steps as well; where it does not, its gradient is not computed.
        inputs: Of the loss.
    """
    agent: Any = state

    def without_encoder(networks: tuple[Any, Any], *inputs: Any) -> Any:
        return loss((networks[0], jax.lax.stop_gradient(networks[1])), *inputs)

    def gradients(loss: Callable[..., Any]) -> Callable[[Any], Any]:
        gradient_of: Callable[..., Any] = eqx.filter_value_and_grad(loss, has_aux=True)
        return lambda networks: gradient_of(networks, *inputs)

    networks = (agent.critic, agent.encoder)
    if isinstance(learns, bool):
        found = gradients(loss if learns else without_encoder)(networks)
    else:
        found = jax.lax.cond(learns, gradients(loss), gradients(without_encoder), networks)
    (_, others), (critic_gradient, encoder_gradient) = found
    rates = agent.config
    critic, critic_optimizer = step(
        agent.critic, critic_gradient, agent.critic_optimizer, rates.critic_learning_rate
    )
    agent = replace(agent, critic=critic, critic_optimizer=critic_optimizer)
    if learns is False:
        return agent, others
    before = (agent.encoder, agent.encoder_optimizer)
    after = step(*(before[0], encoder_gradient, before[1], rates.encoder_learning_rate))
    if learns is not True:
        after = jax.tree.map(lambda new, old: jnp.where(learns, new, old), after, before)
    return replace(agent, encoder=after[0], encoder_optimizer=after[1]), others


def updates(state: optax.OptState) -> Any:
    """Return how many steps were taken."""
    return optax.tree_utils.tree_get(state, "count")
