"""The paper's formulas as pure functions, in the order of the appendix.

Every function works on whole batches, draws nothing and keeps no state.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

Tree = TypeVar("Tree", bound=PyTree)

LOG_SCALE_MIN = -20.0
LOG_SCALE_MAX = 2.0


def td_target(
    reward: Float[Array, " B"],
    terminated: Float[Array, " B"],
    next_value: Float[Array, " B"],
    discount: float | Float[Array, " B"],
) -> Float[Array, " B"]:
    """Return the target of Q, r + γ (1 - terminated) V(s', g), shape ``(B,)``."""
    return reward + discount * (1 - terminated) * next_value


def critic_loss(q: Float[Array, "2 B"], target: Float[Array, " B"]) -> Float[Array, ""]:
    """Return half the squared error, summed over the critics, averaged over the batch."""
    return 0.5 * ((q - target) ** 2).sum(0).mean()


def value_bound(discount: float) -> float:
    """Return the largest number of discounted steps, 1 / (1 - γ): values lie in [-bound, 0]."""
    return 1 / (1 - discount)


def subgoal_cost(
    value_to_subgoal: Float[Array, " B"],
    value_from_subgoal: Float[Array, " B"],
    value_bound: float,
) -> Float[Array, " B"]:
    """Return max(|V(s, s_g)|, |V(s_g, g)|) with V clipped to [-bound, 0], shape ``(B,)``."""
    legs = jnp.stack([value_to_subgoal, value_from_subgoal])
    return jnp.abs(jnp.clip(legs, -value_bound, 0.0)).max(0)


def advantage_weights(
    advantage: Float[Array, " B"], advantage_temperature: float
) -> Float[Array, " B"]:
    """Return exp(A / λ) / Z as a softmax over the batch (eq. 15-17), shape ``(B,)``, sum 1."""
    return jax.nn.softmax(advantage / advantage_temperature)


def subgoal_loss(
    log_likelihood: Float[Array, " B"], weight: Float[Array, " B"]
) -> Float[Array, ""]:
    """Return the weighted negative log-likelihood of the subgoal candidates (eq. 17)."""
    return -(weight * log_likelihood).sum()


def prior_log_density(
    log_densities: Float[Array, "B num_subgoals"], epsilon: float
) -> Float[Array, " B"]:
    """Return log[1/I Σ_i π_θ'(a | s, s_g^i) + ε] from the I log-densities (eq. 18).

    Summed as logarithms, so that large densities do not overflow.
    """
    count = log_densities.shape[1]
    log_mean = jax.nn.logsumexp(log_densities, axis=1) - jnp.log(count)
    return jnp.logaddexp(log_mean, jnp.log(epsilon))


def kl_estimate(
    log_density: Float[Array, " B"], prior_log_density: Float[Array, " B"]
) -> Float[Array, " B"]:
    """Return the one-sample estimate of D_KL(π_θ || π_prior) (eq. 19, N = 1), shape ``(B,)``."""
    return log_density - prior_log_density


def kl_policy_loss(
    kl: Float[Array, " B"], q: Float[Array, " B"], kl_weight: float
) -> Float[Array, ""]:
    """Return the mean of α D_KL(π || π_prior) - Q (appendix B, actor-critic)."""
    return (kl_weight * kl - q).mean()


def target_update(online: Tree, target: Tree, target_update_rate: float) -> Tree:
    """Return τ online + (1 - τ) target (appendix B): an exponential moving average."""
    moved: Tree = jax.tree.map(
        lambda o, t: (
            target_update_rate * o + (1 - target_update_rate) * t if eqx.is_inexact_array(t) else t
        ),
        online,
        target,
    )
    return moved


def copy(network: Tree) -> Tree:
    """Return the tree with arrays of its own, so that both may be donated to one call."""
    own: Tree = jax.tree.map(lambda x: jnp.copy(x) if eqx.is_array(x) else x, network)
    return own


def gaussian_log_density(
    x: Float[Array, "*#B D"], mean: Float[Array, "*#B D"], log_std: Float[Array, "*#B D"]
) -> Float[Array, "*B"]:
    """Return the log-density of a diagonal Gaussian, summed over the last axis."""
    z = (x - mean) * jnp.exp(-log_std)
    return (-0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)).sum(-1)


def laplace_log_density(
    x: Float[Array, "*#B D"], location: Float[Array, "*#B D"], log_scale: Float[Array, "*#B D"]
) -> Float[Array, "*B"]:
    """Return the log-density of independent Laplace variables, summed over the last axis."""
    return (-jnp.abs(x - location) * jnp.exp(-log_scale) - log_scale - jnp.log(2.0)).sum(-1)


def tanh_log_determinant(pre_tanh: Float[Array, "*B D"]) -> Float[Array, "*B"]:
    """Return log |d tanh(u) / du| = Σ 2 (log 2 - u - softplus(-2u)), summed over the last axis."""
    return (2 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2 * pre_tanh))).sum(-1)
