"""Beyond the paper: what `quick` adds to RIS and SAC; each function is one setting of theirs.

Formulas, reasons and measured effects: docs/algorithms/ris.md, section "Beyond the paper".
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from midway import functional
from midway.networks import encoder as encoders
from midway.networks import inputs
from midway.networks.critics import TwinCritic
from midway.networks.encoder import Encoder, EncoderConfig
from midway.networks.inputs import GOAL_INPUTS, GoalInputs, PairInputs
from midway.networks.policies import GaussianPolicy, SubgoalPolicy
from midway.settings import setting
from midway.types import Batch, EnvSpec, Metrics, Sampling, Subgoal

State = TypeVar("State", bound=eqx.Module)


@dataclass(frozen=True)
class Settings:
    """Settings of RIS and SAC beyond the paper; with the defaults there are none."""

    n_step: int = setting(1, "none", "steps of the return before the critics", least=1, most=50)
    clip_targets: bool = setting(False, "none", "targets within [-1 / (1 - γ), 0]")
    hindsight_bound: bool = setting(False, "none", "values not below the episode's own way")
    unreached_goals: bool = setting(False, "none", "no goals that are reached already")
    num_critics: int = setting(2, "appendix B", "Q networks", choices=(1, 2))
    layer_norm: bool = setting(False, "none", "in the critics")
    normalise: bool = setting(False, "none", "states by the environment's center and spread")
    goal_inputs: GoalInputs = setting("whole", "none", "of the networks", choices=GOAL_INPUTS)
    policy_every: int = setting(1, "code of RIS", "updates for each of the policy", least=1)
    network: str = setting("", "none", "module:function that makes networks; nothing: an MLP")
    failure_cost: float = setting(1.0, "ours", "of a failed episode, times 1 / (1 - γ)", least=0)


@dataclass(frozen=True)
class SubgoalSettings(Settings):
    """Settings of RIS beyond the paper; with the defaults there are none."""

    subgoal_every: int = setting(
        1, "code of RIS", "updates for each of the subgoal policy", least=1
    )
    candidates_per_pair: int = setting(1, "one, all in one softmax", "subgoals weighed", least=1)
    candidate_pairs: int = setting(32, "none", "rows with candidates of their own", least=1)


@runtime_checkable
class ActorCritic(EncoderConfig, Protocol):
    """What encoder, critics and policy need of a configuration besides `Settings`."""

    @property
    def hidden(self) -> tuple[int, ...]:
        """Layers of every network."""

    @property
    def num_critics(self) -> int:
        """Q networks."""

    @property
    def layer_norm(self) -> bool:
        """Whether critics have it."""

    @property
    def goal_inputs(self) -> GoalInputs:
        """What networks read of a goal."""

    @property
    def network(self) -> str:
        """What makes policies and critics (`midway.networks.custom`)."""


@runtime_checkable
class Discounted(Protocol):
    """Settings with a discount factor γ, which each agent declares beside its own."""

    @property
    def discount(self) -> float:
        """γ."""

    @property
    def n_step(self) -> int:
        """Steps of the return before the critics take over."""

    @property
    def clip_targets(self) -> bool:
        """Whether targets are kept in [-1 / (1 - γ), 0]."""

    @property
    def hindsight_bound(self) -> bool:
        """Whether the way that the episode took to the goal bounds its value from below."""

    @property
    def failure_cost(self) -> float:
        """Cost of an episode that fails, times 1 / (1 - γ)."""

    @property
    def unreached_goals(self) -> bool:
        """Whether goals that are reached already are drawn again."""


@runtime_checkable
class Weighed(Discounted, Protocol):
    """Settings with candidates of each pair, and a temperature λ."""

    @property
    def advantage_temperature(self) -> float:
        """λ."""

    @property
    def candidates_per_pair(self) -> int:
        """Candidates of each pair."""

    @property
    def candidate_pairs(self) -> int:
        """Rows of the batch that have them."""


def actor_critic(
    config: "ActorCritic", spec: EnvSpec, keys: tuple[Key[Array, ""], ...]
) -> tuple[Encoder, TwinCritic, GaussianPolicy]:
    """Return encoder, critics and policy at their random start, from a key for each."""
    encoder = encoders.create(spec, config, keys[0])
    read = inputs.create(spec, config.goal_inputs, encoder)
    pair, layers = pair_size(spec, read), (config.hidden, config.precision)
    critic = TwinCritic(
        pair + spec.action_dim,
        *layers,
        key=keys[1],
        inputs=read,
        layer_norm=config.layer_norm,
        count=config.num_critics,
        custom=config.network,
    )
    policy = GaussianPolicy(
        pair, spec.action_dim, *layers, key=keys[2], inputs=read, custom=config.network
    )
    return encoder, critic, policy


def pair_size(spec: EnvSpec, read: PairInputs) -> int:
    """Return how many numbers networks read of a state and a goal."""
    observation_size, goal_size = encoders.feature_sizes(spec)
    return observation_size + read.size(goal_size)


def sampling(config: Discounted) -> Sampling:
    """Return what an agent of these settings wants to be drawn."""
    return Sampling(config.n_step, config.unreached_goals, config.hindsight_bound)


def subgoal_sampling(config: "Weighed") -> Sampling:
    """Return what RIS wants to be drawn: states in between for candidates of each pair too."""
    return replace(sampling(config), between=config.candidates_per_pair > 1)


def n_step_target(
    batch: Batch, next_value: Float[Array, " B"], config: "Discounted"
) -> Float[Array, " B"]:
    """Return the target of Q after n steps: -(1 - γ^n) / (1 - γ) + γ^n (1 - terminated) V(s_n, g).

    For n = 1 this is `functional.td_target` with reward -1. Then the two bounds, where asked for:
    never below what the episode itself needed to the goal, never outside [-1 / (1 - γ), 0]. A step
    that fails is worth ``failure_cost`` times -1 / (1 - γ): as much as never to get there.
    """
    discount = config.discount
    kept = discount if batch.steps is None else discount**batch.steps
    reward = batch.reward if batch.steps is None else discounted(batch.steps, discount)
    terminated = batch.terminated.astype(jnp.float32)
    target = functional.td_target(reward, terminated, next_value, kept)
    if config.hindsight_bound and batch.reached_in is not None:
        target = jnp.maximum(target, discounted(batch.reached_in, discount))
    if batch.failed is not None:
        lost = -config.failure_cost * functional.value_bound(discount)
        before = jnp.zeros_like(target) if batch.steps is None else batch.steps - 1
        failure = discounted(before, discount) + discount**before * lost
        target = jnp.where(batch.failed, failure, target)
    if config.clip_targets:
        target = jnp.clip(target, -functional.value_bound(discount), 0.0)
    return target


def discounted(steps: Float[Array, " B"], discount: float) -> Float[Array, " B"]:
    """Return the value of a goal that is so many steps away, -(1 - γ^n) / (1 - γ)."""
    return -(1 - discount**steps) / (1 - discount)


def candidate_weights(cost: Float[Array, "N C"], temperature: float) -> Float[Array, "N C"]:
    """Return the softmax of -cost / temperature over the candidates of each pair."""
    return jax.nn.softmax(-cost / temperature, axis=1)


def candidates_of_each_pair(batch: Batch, count: int, pairs: int) -> tuple[Batch, Array]:
    """Return some rows of the batch, evenly spaced, and candidates ``(N, C, S)`` for each.

    The first is a state in between: from the same episode where the goal is a later state of it.
    The others are candidates of other rows.
    """
    size = len(batch.action)
    stride = max(1, size // pairs)
    few = jax.tree.map(lambda x: x[::stride], batch)
    steps = 1 + jnp.arange(count - 1) * max(1, size // count)
    index = (jnp.arange(0, size, stride)[:, None] + steps) % size
    others = batch.subgoal_candidate.observation[index]
    return few, jnp.concatenate([few.between[:, None], others], axis=1)


def candidate_loss(
    subgoal_policy: SubgoalPolicy,
    cost_of: Callable[[Batch, Subgoal], Float[Array, " M"]],
    batch: Batch,
    spec: EnvSpec,
    config: "Weighed",
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss of eq. 17 where each pair has candidates, and a softmax, of its own.

    -1/N Σ_n Σ_c w_nc log π^H(s_nc | s_n, g_n), with w_nc the softmax of -cost / λ over c.

    Args:
        subgoal_policy: π^H.
        cost_of: The cost of one candidate for each row of a batch.
        batch: Transitions with candidates and states in between.
        spec: The environment.
        config: How many candidates, for how many rows, and λ.
    """
    few, candidates = candidates_of_each_pair(
        batch, config.candidates_per_pair, config.candidate_pairs
    )
    count = candidates.shape[1]
    repeated = few._replace(
        observation=jnp.repeat(few.observation, count, axis=0),
        goal=jnp.repeat(few.goal, count, axis=0),
    )
    flat = candidates.reshape(-1, candidates.shape[-1])
    cost = jax.lax.stop_gradient(cost_of(repeated, encoders.as_subgoal(spec, flat))).reshape(
        -1, count
    )
    weight = candidate_weights(cost, config.advantage_temperature)
    subgoals = subgoal_policy(few.observation[:, None], few.goal[:, None])
    log_density = subgoals.log_density(subgoal_policy.inputs.pick(candidates))
    loss = -(weight * log_density).sum(1).mean()
    return loss, {
        "subgoal/loss": loss,
        "subgoal/advantage": ((weight - 1 / count) * -cost).sum(1).mean(),
        "subgoal/effective_candidates": (1 / (weight**2).sum(1)).mean(),
        "subgoal/scale": jnp.exp(subgoals.log_scale).mean(),
    }


def every(
    updates: Int[Array, ""],
    count: int,
    step: Callable[..., tuple[State, Metrics]],
    state: State,
    *inputs: PyTree,
) -> tuple[State, Metrics]:
    """Return the state after a step that is taken in one of ``count`` updates only.

    Its metrics are multiplied by ``count`` where it was taken and 0 elsewhere, so that means over
    many updates are means over its own.
    """
    if count == 1:
        return step(state, *inputs)
    arrays, static = eqx.partition(state, eqx.is_array)

    def taken(arrays: State) -> tuple[State, Metrics]:
        new, metrics = step(eqx.combine(arrays, static), *inputs)
        return eqx.filter(new, eqx.is_array), {k: count * v for k, v in metrics.items()}

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(taken, arrays)[1])
    due = updates % count == 0
    new, metrics = jax.lax.cond(due, taken, lambda arrays: (arrays, nothing), arrays)
    return eqx.combine(new, static), metrics
