"""The cross-entropy method: a search for the smallest value of a batched cost function."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

Cost = Callable[[Float[Array, "N ..."]], Float[Array, " N"]]
"""The costs of N candidates."""


def minimise(
    cost: Cost,
    mean: Float[Array, "..."],
    std: float,
    num_elites: Int[Array, " iterations"],
    num_samples: int,
    key: Key[Array, ""],
) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """Return the best candidate of the last iteration and its cost.

    Each iteration draws candidates from a diagonal Gaussian and refits it to those of the smallest
    costs, without smoothing (code of LEAP; the appendix says nothing of the search). The compiled
    program is a scan over the iterations.

    Args:
        cost: The cost function, on candidates ``(num_samples, *shape)``.
        mean: Mean of the first iteration.
        std: Standard deviation of the first iteration, of every number.
        num_elites: For each iteration, from how many candidates the Gaussian is refitted.
        num_samples: Candidates of each iteration.
        key: Key of the draws.
    """

    def iterate(
        gaussian: tuple[Float[Array, "..."], Float[Array, "..."]],
        step: tuple[Key[Array, ""], Int[Array, ""]],
    ) -> tuple[
        tuple[Float[Array, "..."], Float[Array, "..."]],
        tuple[Float[Array, "..."], Float[Array, ""]],
    ]:
        step_key, elites = step
        mean, std = gaussian
        candidates = mean + std * jax.random.normal(step_key, (num_samples, *mean.shape))
        costs = cost(candidates)
        best = jnp.argmin(costs)
        return refit(candidates, costs, elites), (candidates[best], costs[best])

    keys = jax.random.split(key, num_elites.shape[0])
    _, (best, costs) = jax.lax.scan(iterate, (mean, jnp.full_like(mean, std)), (keys, num_elites))
    return best[-1], costs[-1]


def refit(
    candidates: Float[Array, "N ..."], costs: Float[Array, " N"], num_elites: Int[Array, ""]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return mean and standard deviation of the candidates of the smallest costs."""
    rank = jnp.argsort(jnp.argsort(costs))
    weight = (rank < num_elites) / num_elites
    mean = jnp.tensordot(weight, candidates, 1)
    variance = jnp.tensordot(weight, (candidates - mean) ** 2, 1)
    return mean, jnp.sqrt(variance)


def elite_schedule(
    num_samples: int, iterations: int, fractions: tuple[float, ...]
) -> Int[Array, " iterations"]:
    """Return numbers of elites: the fractions of the samples, each for an equal part of the time.

    With 10,000 samples, 50 iterations and (0.25, 0.01): 2,500 for 25 iterations, then 100.
    """
    phase = jnp.arange(iterations) * len(fractions) // iterations
    numbers = jnp.array([max(1, round(fraction * num_samples)) for fraction in fractions])
    return numbers[phase]
