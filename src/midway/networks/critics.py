"""Goal-conditioned critics."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from midway.networks.mlp import MLP, Precision


class TwinCritic(eqx.Module):
    """Two Q networks, Q_φ1(s, a, g) and Q_φ2(s, a, g).

    Two networks rather than one batched product: on processors the latter is no faster.
    """

    first: MLP
    second: MLP

    def __init__(
        self,
        input_size: int,
        hidden: tuple[int, ...],
        precision: Precision,
        *,
        key: Key[Array, ""],
    ) -> None:
        first_key, second_key = jax.random.split(key)
        self.first = MLP(input_size, hidden, 1, precision, key=first_key)
        self.second = MLP(input_size, hidden, 1, precision, key=second_key)

    def __call__(
        self,
        observation: Float[Array, "B O"],
        action: Float[Array, "B A"],
        goal: Float[Array, "B G"],
    ) -> Float[Array, "2 B"]:
        """Return the Q values of both networks, shape ``(2, B)``."""
        inputs = jnp.concatenate([observation, action, goal], axis=-1)
        return jnp.stack([self.first(inputs)[:, 0], self.second(inputs)[:, 0]])
