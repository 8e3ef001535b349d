"""Starts of networks other than the uniform one of `midway.networks.mlp.Linear`."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from midway.networks.convolution import Filter
from midway.networks.mlp import MLP, Linear


def with_small_output(network: MLP, bound: float) -> MLP:
    """Return a newly made network with its output layer uniform in ±bound instead of ±1/√in."""
    output = network.layers[-1]
    factor = bound * output.weight.shape[0] ** 0.5
    small = jax.tree.map(lambda x: factor * x if eqx.is_inexact_array(x) else x, output)
    changed: MLP = eqx.tree_at(lambda n: n.layers[-1], network, small)
    return changed


def with_orthogonal_weight(layer: Linear, key: Key[Array, ""]) -> Linear:
    """Return the layer with an orthogonal weight and no bias."""
    weight = jax.nn.initializers.orthogonal()(key, layer.weight.shape)
    start = (weight, jnp.zeros_like(layer.bias))
    changed: Linear = eqx.tree_at(lambda n: (n.weight, n.bias), layer, start)
    return changed


def with_centre_tap(layer: Filter, key: Key[Array, ""]) -> Filter:
    """Return the filter that maps each pixel alone: orthogonal with gain √2, and no bias."""
    centre = layer.weight.shape[0] // 2
    tap = jax.nn.initializers.orthogonal(2**0.5)(key, layer.weight.shape[2:])
    weight = jnp.zeros_like(layer.weight).at[centre, centre].set(tap)
    start = (weight, jnp.zeros_like(layer.bias))
    changed: Filter = eqx.tree_at(lambda n: (n.weight, n.bias), layer, start)
    return changed
