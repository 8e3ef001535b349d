"""Starts of networks other than the uniform one of `midway.networks.mlp.Linear`."""

import equinox as eqx
import jax

from midway.networks.mlp import MLP


def with_small_output(network: MLP, bound: float) -> MLP:
    """Return a newly made network with its output layer uniform in ±bound instead of ±1/√in."""
    output = network.layers[-1]
    factor = bound * output.weight.shape[0] ** 0.5
    small = jax.tree.map(lambda x: factor * x if eqx.is_inexact_array(x) else x, output)
    changed: MLP = eqx.tree_at(lambda n: n.layers[-1], network, small)
    return changed
