"""The compiled steps: sample and update, act, and write to the replay."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from midway.agent import AgentState, AnyAgent, Inputs, Memory
from midway.replay import buffer
from midway.replay.storage import ReplayState
from midway.training import acting
from midway.training.config import TrainConfig
from midway.training.devices import Devices, compile_by_lane
from midway.types import EnvSpec, Hyperparameters, Metrics, Sampling

Arrays: TypeAlias = PyTree
"""The arrays of an agent's state; what is static in it is compiled in."""


@dataclass(frozen=True)
class Program:
    """An agent's functions compiled over the arrays of its state, for one specification.

    Attributes:
        static: What is static in the agent's state.
        train: ``(arrays, totals, replay, key, updates) -> (arrays, totals)``: several updates, each
            on a batch of its own; arrays and totals are donated.
        act: ``(arrays, memory, observation, goal, key) -> (actions, memory)``, sampled.
        act_mean: The same with deterministic actions.
    """

    static: AgentState
    train: Callable[..., tuple[Arrays, Metrics]]
    act: Callable[..., tuple[Float[Array, "K action_dim"], Memory]]
    act_mean: Callable[..., tuple[Float[Array, "K action_dim"], Memory]]

    @property
    def spec(self) -> EnvSpec:
        """What the networks were made for."""
        return self.static.spec

    def state(self, arrays: Arrays) -> AgentState:
        """Return the agent's state."""
        state: AgentState = eqx.combine(arrays, self.static)
        return state


def create_state(
    agent: AnyAgent, config: Hyperparameters, spec: EnvSpec, key: Key[Array, ""]
) -> AgentState:
    """Return the agent's state at its start, made by one compiled program rather than dozens."""
    state: AgentState = eqx.filter_jit(agent.create)(config, spec, key)
    return state


def compile_program(
    agent: AnyAgent, static: AgentState, config: TrainConfig, devices: Devices
) -> Program:
    """Return the agent's compiled functions; each is traced once for the run's shapes."""
    spec, size = static.spec, batch_size(config, static.spec)
    wanted = sampling(agent, static)

    def train(
        arrays: Arrays,
        totals: Metrics,
        replay: ReplayState,
        key: Key[Array, ""],
        updates: Int[Array, ""],
    ) -> tuple[Arrays, Metrics]:
        def one(
            carry: tuple[Arrays, Metrics], count: Int[Array, ""]
        ) -> tuple[tuple[Arrays, Metrics], None]:
            arrays, totals = carry
            sample_key, update_key = jax.random.split(jax.random.fold_in(key, count))
            batch = buffer.sample(replay, spec, config.relabel, size, sample_key, wanted)
            # Whole first: what to draw is then computed on every device, and only rows are sent.
            batch = devices.split_inside(devices.copied_inside(batch))
            state, metrics = agent.update(eqx.combine(arrays, static), batch, update_key)
            arrays = eqx.filter(state, eqx.is_array)
            return (arrays, jax.tree.map(jnp.add, totals, metrics)), None

        counts = updates + jnp.arange(config.updates_per_call(spec.is_image))
        return jax.lax.scan(one, (arrays, totals), counts)[0]

    def act(
        arrays: Arrays,
        memory: Memory,
        observation: Inputs,
        goal: Inputs,
        key: Key[Array, ""],
        *,
        explore: bool,
    ) -> tuple[Float[Array, "K action_dim"], Memory]:
        state: AgentState = eqx.combine(arrays, static)
        return acting.act(agent, state, memory, observation, goal, key, explore=explore)

    return Program(
        static=static,
        train=devices.compile(train, donate_argnums=(0, 1)),
        act=devices.compile(partial(act, explore=True)),
        act_mean=devices.compile(partial(act, explore=False)),
    )


def sampling(agent: AnyAgent, static: AgentState) -> Sampling:
    """Return what the agent wants of a batch."""
    return agent.sampling(static.config) if agent.sampling else Sampling()


def batch_size(config: TrainConfig, spec: EnvSpec) -> int:
    """Return how many transitions an update draws: fewer, if asked, where it encodes images."""
    return (config.encoder_batch_size if spec.is_image else 0) or config.batch_size


def empty_totals(
    agent: AnyAgent, program: Program, arrays: Arrays, config: TrainConfig, replay: ReplayState
) -> Metrics:
    """Return zeros for the sums of every scalar that an update reports."""
    spec = program.spec

    def metrics(arrays: Arrays, replay: ReplayState, key: Key[Array, ""]) -> Metrics:
        size, wanted = batch_size(config, spec), sampling(agent, program.static)
        batch = buffer.sample(replay, spec, config.relabel, size, key, wanted)
        return agent.update(program.state(arrays), batch, key)[1]

    shapes = jax.eval_shape(metrics, arrays, replay, jax.random.key(0))
    return {name: jnp.zeros(shape.shape, shape.dtype) for name, shape in shapes.items()}


begin = compile_by_lane(buffer.begin)
"""Start episodes in place (`midway.replay.buffer.begin`)."""

add = compile_by_lane(buffer.add)
"""Append steps in place (`midway.replay.buffer.add`)."""

withdraw = compile_by_lane(buffer.withdraw)
"""Take newest episodes out in place (`midway.replay.buffer.withdraw`)."""
