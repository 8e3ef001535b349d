"""Beyond the paper: what `quick` adds to RIS and SAC; each function is one setting of theirs.

Formulas, reasons and measured effects: docs/algorithms/ris.md, section "Beyond the paper".
"""

from collections.abc import Callable
from dataclasses import dataclass
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
from midway.networks.policies import GaussianPolicy
from midway.settings import setting
from midway.types import Batch, EnvSpec, Metrics, Sampling

State = TypeVar("State", bound=eqx.Module)


@dataclass(frozen=True)
class Settings:
    """Settings of RIS and SAC beyond the paper; with the defaults there are none."""

    n_step: int = setting(1, "none", "steps of the return before the critics", least=1, most=50)
    clip_targets: bool = setting(False, "none", "targets within [-1 / (1 - γ), 0]")
    unreached_goals: bool = setting(False, "none", "no goals that are reached already")
    num_critics: int = setting(2, "appendix B", "Q networks", choices=(1, 2))
    layer_norm: bool = setting(False, "none", "in the critics")
    normalise: bool = setting(False, "none", "states by the environment's center and spread")
    goal_inputs: GoalInputs = setting("whole", "none", "of the networks", choices=GOAL_INPUTS)
    policy_every: int = setting(1, "code of RIS", "updates for each of the policy", least=1)
    halve_rates_after: int = setting(
        0, "none", "updates of a network that halve its learning rate; 0: none do", least=0
    )
    network: str = setting("", "none", "module:function that makes networks; nothing: an MLP")
    failure_cost: float = setting(1.0, "ours", "of a failed episode, times 1 / (1 - γ)", least=0)


@dataclass(frozen=True)
class SubgoalSettings(Settings):
    """Settings of RIS beyond the paper; with the defaults there are none."""

    subgoal_every: int = setting(
        1, "code of RIS", "updates for each of the subgoal policy", least=1
    )
    policy_average_rate: float = setting(
        0.0, "none", "of the policy that acts without noise; 0: no average", least=0, most=1
    )


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
    def failure_cost(self) -> float:
        """Cost of an episode that fails, times 1 / (1 - γ)."""

    @property
    def unreached_goals(self) -> bool:
        """Whether goals that are reached already are drawn again."""


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
    return Sampling(config.n_step, config.unreached_goals)


def n_step_target(
    batch: Batch, next_value: Float[Array, " B"], config: "Discounted"
) -> Float[Array, " B"]:
    """Return the target of Q after n steps: -(1 - γ^n) / (1 - γ) + γ^n (1 - terminated) V(s_n, g).

    For n = 1 this is `functional.td_target` with reward -1. Clipped, it is never outside
    [-1 / (1 - γ), 0]. A step that fails is worth ``failure_cost`` times -1 / (1 - γ): as much as
    never to get there.
    """
    discount = config.discount
    kept = discount if batch.steps is None else discount**batch.steps
    reward = batch.reward if batch.steps is None else discounted(batch.steps, discount)
    terminated = batch.terminated.astype(jnp.float32)
    target = functional.td_target(reward, terminated, next_value, kept)
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
