"""Goal-conditioned policies: a squashed Gaussian over actions, a Laplace over subgoals."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from midway.functional import (
    LOG_SCALE_MAX,
    LOG_SCALE_MIN,
    gaussian_log_density,
    laplace_log_density,
    tanh_log_determinant,
)
from midway.networks.custom import Network, create
from midway.networks.inputs import PairInputs
from midway.networks.mlp import Precision


class Gaussian(NamedTuple):
    """A diagonal Gaussian over actions before the tanh."""

    mean: Float[Array, "*B A"]
    log_std: Float[Array, "*B A"]

    def sample(self, noise: Float[Array, "*B A"]) -> Float[Array, "*B A"]:
        """Return mean + std * noise, the reparametrised pre-tanh action."""
        return self.mean + jnp.exp(self.log_std) * noise

    def act(self, key: Key[Array, ""], explore: bool) -> Float[Array, "*B A"]:
        """Return actions in [-1, 1]: sampled where ``explore``, else the tanh of the mean."""
        if not explore:
            return jnp.tanh(self.mean)
        return jnp.tanh(self.sample(jax.random.normal(key, self.mean.shape)))

    def squashed(
        self, noise: Float[Array, "*B A"]
    ) -> tuple[Float[Array, "*B A"], Float[Array, "*B"]]:
        """Return tanh-squashed actions and their log-densities log π_θ(a | s, g)."""
        pre_tanh = self.sample(noise)
        log_density = self.log_density(pre_tanh) - tanh_log_determinant(pre_tanh)
        return jnp.tanh(pre_tanh), log_density

    def log_density(self, pre_tanh: Float[Array, "*#B A"]) -> Float[Array, "*#B"]:
        """Return the log-density of pre-tanh actions, broadcast against the distributions."""
        return gaussian_log_density(pre_tanh, self.mean, self.log_std)


class Laplace(NamedTuple):
    """Independent Laplace variables, one for each number of a subgoal."""

    location: Float[Array, "*B S"]
    log_scale: Float[Array, "*B S"]

    def sample(self, key: Key[Array, ""], count: int) -> Float[Array, "*B {count} S"]:
        """Return ``count`` subgoals for each distribution."""
        shape = (*self.location.shape[:-1], count, self.location.shape[-1])
        noise = jax.random.laplace(key, shape)
        return self.location[..., None, :] + jnp.exp(self.log_scale)[..., None, :] * noise

    def log_density(self, subgoal: Float[Array, "*#B S"]) -> Float[Array, "*#B"]:
        """Return the log-density of subgoals, broadcast against the distributions."""
        return laplace_log_density(subgoal, self.location, self.log_scale)


class GaussianPolicy(eqx.Module):
    """π_θ(a | s, g) = tanh N(μ_θ(s, g), Σ_θ(s, g)) (appendix B, actor-critic)."""

    network: Network
    inputs: PairInputs

    def __init__(
        self,
        input_size: int,
        action_dim: int,
        hidden: tuple[int, ...],
        precision: Precision,
        *,
        key: Key[Array, ""],
        inputs: PairInputs | None = None,
        custom: str = "",
    ) -> None:
        self.inputs = inputs or PairInputs()
        sizes = (input_size, hidden, 2 * action_dim)
        self.network = create(custom, sizes, precision, key=key)

    def __call__(self, observation: Float[Array, "..."], goal: Float[Array, "..."]) -> Gaussian:
        """Return the distribution of pre-tanh actions; inputs may broadcast as in `MLP`."""
        mean, log_std = jnp.split(self.network(*self.inputs(observation, goal)), 2, axis=-1)
        return Gaussian(mean, jnp.clip(log_std, LOG_SCALE_MIN, LOG_SCALE_MAX))


class SubgoalPolicy(eqx.Module):
    """π^H_ψ(s_g | s, g), the high-level policy: a Laplace over states (appendix B)."""

    network: Network
    inputs: PairInputs

    def __init__(
        self,
        input_size: int,
        subgoal_size: int,
        hidden: tuple[int, ...],
        precision: Precision,
        *,
        key: Key[Array, ""],
        inputs: PairInputs | None = None,
        custom: str = "",
    ) -> None:
        self.inputs = inputs or PairInputs()
        sizes = (input_size, hidden, 2 * subgoal_size)
        self.network = create(custom, sizes, precision, key=key)

    def __call__(self, observation: Float[Array, "..."], goal: Float[Array, "..."]) -> Laplace:
        """Return the distribution of subgoals between each observation and goal."""
        location, log_scale = jnp.split(self.network(*self.inputs(observation, goal)), 2, axis=-1)
        return Laplace(location, jnp.clip(log_scale, LOG_SCALE_MIN, LOG_SCALE_MAX))
