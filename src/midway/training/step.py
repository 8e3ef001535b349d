"""The compiled steps: sample and update, act, and write to the replay."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from midway.replay import buffer
from midway.replay.storage import ReplayState
from midway.training import acting, codes
from midway.training.config import TrainConfig
from midway.training.devices import Devices, compile_by_lane
from midway.types import EnvSpec, Memory, Metrics

Arrays: TypeAlias = PyTree
"""The arrays of an agent's state; what is static in it is compiled in."""


@dataclass(frozen=True)
class Learner:
    """An agent's functions compiled over the arrays of its state.

    Attributes:
        train: ``(arrays, totals, replay, key, updates) -> (arrays, totals)``: several updates, each
            on a batch of its own; arrays and totals are donated.
        act: ``(arrays, memory, observation, goal, key) -> (actions, memory)``, sampled.
        act_mean: The same with the tanh of the mean.
    """

    train: Callable[..., tuple[Arrays, Metrics]]
    act: Callable[..., tuple[Float[Array, "K action_dim"], Memory]]
    act_mean: Callable[..., tuple[Float[Array, "K action_dim"], Memory]]


def create_state(agent: ModuleType, config: Any, spec: EnvSpec, key: Key[Array, ""]) -> Any:
    """Return the agent's state at its start, made by one compiled program rather than dozens."""
    return eqx.filter_jit(agent.create)(config, spec, key)


def split_state(state: eqx.Module) -> tuple[Arrays, Any]:
    """Split an agent's state into its arrays and what is static."""
    arrays, static = eqx.partition(state, eqx.is_array)
    return arrays, static


def compile_learner(
    agent: ModuleType, static: Any, config: TrainConfig, spec: EnvSpec, devices: Devices
) -> Learner:
    """Return the agent's compiled functions; each is traced once for the run's shapes."""

    def train(
        arrays: Arrays, totals: Metrics, replay: ReplayState, key: Key[Array, ""], updates: Any
    ) -> tuple[Arrays, Metrics]:
        size = batch_size(config, replay)

        def one(carry: tuple[Arrays, Metrics], count: Any) -> tuple[tuple[Arrays, Metrics], None]:
            arrays, totals = carry
            sample_key, update_key = jax.random.split(jax.random.fold_in(key, count))
            batch = buffer.sample(replay, spec, config.relabel, size, sample_key)
            # Whole first: what to draw is then computed on every device, and only rows are sent.
            batch = devices.split_inside(devices.copied_inside(batch))
            state, metrics = agent.update(eqx.combine(arrays, static), batch, update_key)
            return (split_state(state)[0], jax.tree.map(jnp.add, totals, metrics)), None

        counts = updates + jnp.arange(config.updates_per_call)
        return jax.lax.scan(one, (arrays, totals), counts)[0]

    def act(
        arrays: Arrays, *inputs: Any, explore: bool
    ) -> tuple[Float[Array, "K action_dim"], Memory]:
        return acting.act(agent, eqx.combine(arrays, static), *inputs, explore=explore)

    return Learner(
        train=devices.compile(train, donate_argnums=(0, 1)),
        act=devices.compile(partial(act, explore=True)),
        act_mean=devices.compile(partial(act, explore=False)),
    )


def batch_size(config: TrainConfig, replay: ReplayState) -> int:
    """Return how many transitions an update draws: fewer, if asked, where it must encode images."""
    smaller = config.encoder_batch_size if codes.holds_images(replay) else 0
    return smaller or config.batch_size


def empty_totals(
    agent: ModuleType, arrays: Arrays, static: Any, config: TrainConfig, replay: ReplayState
) -> Metrics:
    """Return zeros for the sums of every scalar that an update reports."""
    spec = static.spec

    def metrics(arrays: Arrays, replay: ReplayState, key: Key[Array, ""]) -> Metrics:
        batch = buffer.sample(replay, spec, config.relabel, batch_size(config, replay), key)
        logged: Metrics = agent.update(eqx.combine(arrays, static), batch, key)[1]
        return logged

    shapes = jax.eval_shape(metrics, arrays, replay, jax.random.key(0))
    return {name: jnp.zeros(shape.shape, shape.dtype) for name, shape in shapes.items()}


begin = compile_by_lane(buffer.begin)
"""Start episodes in place (`midway.replay.buffer.begin`)."""

add = compile_by_lane(buffer.add)
"""Append steps in place (`midway.replay.buffer.add`)."""
