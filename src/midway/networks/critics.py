"""Goal-conditioned critics."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from midway.networks.custom import Network, create
from midway.networks.inputs import PairInputs
from midway.networks.mlp import Precision


class TwinCritic(eqx.Module):
    """Two Q networks, Q_φ1(s, a, g) and Q_φ2(s, a, g), or one alone.

    Two networks rather than one batched product: on processors the latter is no faster.
    """

    first: Network
    second: Network | None
    inputs: PairInputs

    def __init__(
        self,
        input_size: int,
        hidden: tuple[int, ...],
        precision: Precision,
        *,
        key: Key[Array, ""],
        inputs: PairInputs | None = None,
        layer_norm: bool = False,
        count: int = 2,
        custom: str = "",
    ) -> None:
        keys = jax.random.split(key)
        layers = (custom, (input_size, hidden, 1), precision)
        self.first = create(*layers, key=keys[0], layer_norm=layer_norm)
        second = create(*layers, key=keys[1], layer_norm=layer_norm)
        self.second = second if count == 2 else None
        self.inputs = inputs or PairInputs()

    def __call__(
        self,
        observation: Float[Array, "*#B O"],
        action: Float[Array, "*B A"],
        goal: Float[Array, "*#B G"],
    ) -> Float[Array, "#2 *B"]:
        """Return the Q values of each network, shape ``(2, B)`` or ``(1, B)``."""
        observation, goal = self.inputs(observation, goal)
        inputs = jnp.concatenate([observation, action, goal], axis=-1)
        networks = [self.first, *([] if self.second is None else [self.second])]
        return jnp.stack([network(inputs)[..., 0] for network in networks])
