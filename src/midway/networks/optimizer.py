"""One Adam per network: the paper has a learning rate for each (table 1)."""

from typing import TypeVar

import equinox as eqx
import optax
from jaxtyping import PyTree

Network = TypeVar("Network", bound=PyTree)


def init(network: PyTree) -> optax.OptState:
    """Return Adam's state at the start for every array of the network."""
    return optax.adam(0.0).init(eqx.filter(network, eqx.is_inexact_array))


def step(
    network: Network, gradient: PyTree, state: optax.OptState, learning_rate: float
) -> tuple[Network, optax.OptState]:
    """Return the network after one step of Adam against the gradient, and Adam's new state."""
    updates, state = optax.adam(learning_rate).update(gradient, state)
    return eqx.apply_updates(network, updates), state
