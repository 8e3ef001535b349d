"""A run in memory: what its future depends on, how it starts, is frozen and is restored."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np

from midway.agent import AgentState, AnyAgent, Encoder, Memory
from midway.errors import ConfigurationError
from midway.replay import buffer
from midway.replay.storage import ReplayState
from midway.training import acting, demonstrations, freeze, memory, pretrain, seeds, step
from midway.training.archive import Stored
from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.checkpoint import Checkpoints
from midway.training.collect import Collector
from midway.training.config import RESTART, TrainConfig
from midway.training.devices import Devices
from midway.training.pretrain import Check, MakeEnv, Say
from midway.training.step import Arrays, Program
from midway.types import EnvSpec, Hyperparameters, Metrics, Trajectory, VectorGoalEnv

FROZEN = "frozen_encoder"
"""Part of a checkpoint that is there once the encoder is frozen."""


@dataclass(frozen=True)
class Setup:
    """What a run is made of.

    Attributes:
        agent: The agent.
        hyperparameters: Its configuration.
        train: Settings of the loop.
        seed: The one seed of every generator.
        make_env: ``(number of environments, task) -> vector environment``.
        folder: Where pre-training keeps its files.
        demonstrations: Trajectories of others, which the replay holds from the beginning.
    """

    agent: AnyAgent
    hyperparameters: Hyperparameters
    train: TrainConfig
    seed: int
    make_env: MakeEnv
    folder: Path
    demonstrations: Callable[[], Iterable[Trajectory]] | None = None


class Counters(NamedTuple):
    """How far a run is.

    Attributes:
        steps: Environment steps, over all environments.
        updates: Updates of the agent.
        updates_logged: Those of them before the last row of metrics.
        training_seconds: Time of collection and updates (s).
        seconds: Time of everything (s).
    """

    steps: int = 0
    updates: int = 0
    updates_logged: int = 0
    training_seconds: float = 0.0
    seconds: float = 0.0


@dataclass
class Training:
    """A run in memory: what its future depends on, and the programs that move it.

    Attributes:
        setup: What it is made of.
        program: The agent's compiled functions.
        arrays: The arrays of the agent's state.
        totals: Sums of the scalars that updates report, since the last row of metrics.
        replay: The replay.
        memory: What the agent remembers of the running episodes.
        collector: Environments in the middle of their episodes.
        streams: Seeds and keys of all draws.
        encoder: The frozen encoder of images; None while there is none.
        counters: How far it is.
        evaluation_envs: Environments of evaluations by task.
        ends_at: Step that those who watch the run have ended it at, before its settings do.
    """

    setup: Setup
    program: Program
    arrays: Arrays
    totals: Metrics
    replay: ReplayState
    memory: Memory
    collector: Collector
    streams: seeds.Streams
    encoder: Encoder | None = None
    counters: Counters = field(default_factory=Counters)
    evaluation_envs: dict[str, VectorGoalEnv] = field(default_factory=dict)
    ends_at: int | None = None

    @property
    def last_step(self) -> int:
        """The step that the run is finished at."""
        return self.setup.train.steps if self.ends_at is None else self.ends_at

    @property
    def state(self) -> AgentState:
        """The agent's state."""
        return self.program.state(self.arrays)

    @property
    def env_spec(self) -> EnvSpec:
        """What agents may know of the environment itself, images included."""
        return freeze.thawed(self.collector.env).goal_spec

    def begin_episodes(self, count: int, ways: acting.Ways | None = None) -> Memory:
        """Return what the agent remembers at the start of as many episodes."""
        agent, config = self.setup.agent, self.setup.hyperparameters
        fresh = acting.begin(agent, config, self.program.spec, count, ways)
        return _devices(self.setup).copied(fresh)

    def make_env(self, count: int, task: str) -> VectorGoalEnv:
        """Return environments as the agent sees them."""
        return _seen(self.setup, self.setup.make_env(count, task), self.encoder)


# --- start ----------------------------------------------------------------------------------------


def check(setup: Setup) -> None:
    """Find out whether the run can be started, before anything is written.

    Raises:
        ConfigurationError: A lane of the replay is too small, the agent cannot learn from this
            environment, its encoder of images never learns and has a ratio of updates, the machine
            has fewer devices, or too little memory for replay, networks and optimisers.
    """
    train, freezing = setup.train, setup.agent.freezing
    spec = setup.make_env(1, train.task).goal_spec
    never = spec.is_image and freezing is not None and freezing.at_start
    if never and train.encoder_updates_per_step:
        raise ConfigurationError(
            f"encoder_updates_per_step {train.encoder_updates_per_step}: this agent's encoder is "
            "frozen before the first update; use updates_per_step"
        )
    replay = buffer.memory_bytes(spec, train.replay_capacity, train.num_envs)
    _devices(setup)
    key = seeds.training(setup.seed).network_key
    state = eqx.filter_eval_shape(setup.agent.create, setup.hyperparameters, spec, key)
    memory.check({"replay": replay, "networks and optimisers": memory.of_state(state)})


def start(setup: Setup, say: Say | None = None, check: Check = lambda: None) -> Training:
    """Return a run before its first step.

    Args:
        setup: What it is made of.
        say: Is told of pre-training; None to leave the agent's pre-training out, as for a run that
            is about to be restored.
        check: Is called during pre-training; what it raises ends it.
    """
    agent, env = setup.agent, setup.make_env(setup.train.num_envs, setup.train.task)
    started = time.perf_counter()
    state = _create(setup, env.goal_spec)
    if agent.pretrain and say is not None:
        arguments = (setup.make_env, setup.seed, setup.folder, say, check)
        state = pretrain.run(agent.pretrain, state, *arguments)
    seconds = time.perf_counter() - started if agent.pretrain and say is not None else 0.0
    encoder = None
    if agent.freezing and agent.freezing.at_start and env.goal_spec.is_image:
        encoder = agent.freezing.encoder(state)
        state = freeze.keep(agent, _create(setup, _spec(env.goal_spec, encoder)), state)
    training = _begin(setup, env, state, encoder, Counters(seconds=seconds))
    if setup.demonstrations is not None and say is not None:
        _demonstrate(training, setup.demonstrations(), say)
    return training


def _demonstrate(training: Training, trajectories: Iterable[Trajectory], say: Say) -> None:
    """Put trajectories of others into the replay, and begin the episodes anew behind them.

    Raises:
        ConfigurationError: There are none, or the agent reads features of images already.
    """
    setup, spec = training.setup, training.program.spec
    if training.encoder is not None:
        raise ConfigurationError(
            "images of others do not go with an encoder that is frozen already"
        )
    train, env = setup.train, training.collector.env
    replay, count = demonstrations.fill(training.replay, spec, train.num_envs, trajectories)
    training.collector, training.replay = Collector.start(
        env, replay, training.streams.env, train.collect_limit, train.on_env_error == RESTART
    )
    say(f"{count} steps of others in the replay")


def _begin(
    setup: Setup,
    env: VectorGoalEnv,
    state: AgentState,
    encoder: Encoder | None,
    counters: Counters,
) -> Training:
    """Return a run with an empty replay and new episodes."""
    train, devices = setup.train, _devices(setup)
    env = _seen(setup, env, encoder)
    allocate = partial(buffer.create, state.spec, train.replay_capacity, train.num_envs)
    program, arrays = _compiled(setup, state)
    replay = devices.allocate(allocate)
    totals = step.empty_totals(setup.agent, program, arrays, train, replay)
    streams = _streams(setup)
    limits = (train.collect_limit, train.on_env_error == RESTART)
    collector, replay = Collector.start(env, replay, streams.env, *limits)
    parts = (program, arrays, devices.copied(totals), replay, (), collector, streams)
    training = Training(setup, *parts, encoder, counters)
    training.memory = training.begin_episodes(train.num_envs)
    return training


def _devices(setup: Setup) -> Devices:
    return Devices.first(setup.train.devices)


def _streams(setup: Setup) -> seeds.Streams:
    """Return the run's streams with their keys on its devices."""
    streams, devices = seeds.training(setup.seed), _devices(setup)
    return streams._replace(
        network_key=devices.copied(streams.network_key),
        update_key=devices.copied(streams.update_key),
        act_key=devices.copied(streams.act_key),
        evaluation_key=devices.copied(streams.evaluation_key),
    )


def _create(setup: Setup, spec: EnvSpec) -> AgentState:
    """Return the agent's state at its start."""
    key = _streams(setup).network_key
    return step.create_state(setup.agent, setup.hyperparameters, spec, key)


def _compiled(setup: Setup, state: AgentState) -> tuple[Program, Arrays]:
    """Return the agent's compiled functions and its arrays, on the run's devices."""
    devices = _devices(setup)
    arrays, static = eqx.partition(state, eqx.is_array)
    return step.compile_program(setup.agent, static, setup.train, devices), devices.copied(arrays)


def _spec(spec: EnvSpec, encoder: Encoder | None) -> EnvSpec:
    return spec if encoder is None else freeze.encoded_spec(spec, encoder)


def _seen(setup: Setup, env: VectorGoalEnv, encoder: Encoder | None) -> VectorGoalEnv:
    """Return an environment as the agent sees it: through the frozen encoder, if there is one."""
    if encoder is None:
        return env
    weights, static = eqx.partition(encoder, eqx.is_array)
    encode = _devices(setup).compile(lambda weights, x: eqx.combine(weights, static)(x))
    return freeze.FrozenEnv(env, _spec(env.goal_spec, encoder), partial(encode, weights))


# --- freeze --------------------------------------------------------------------------------------


def freeze_encoder(training: Training) -> None:
    """Go on with the features that the encoder, as it is now, makes of images."""
    setup, freezing = training.setup, training.setup.agent.freezing
    if freezing is None:
        return
    encoder, state = freezing.encoder(training.state), training.state
    fresh = _create(setup, _spec(training.program.spec, encoder))
    _see_features(training, encoder, freeze.keep(setup.agent, fresh, state))
    training.replay = freeze.encoded_replay(training.replay, encoder)
    if isinstance(env := training.collector.env, freeze.FrozenEnv):
        training.collector.observation = env.see(training.collector.observation)


def _see_features(training: Training, encoder: Encoder, state: AgentState) -> None:
    """Go on with this state of the agent, on environments seen through the frozen encoder."""
    training.encoder = encoder
    training.program, training.arrays = _compiled(training.setup, state)
    training.collector.env = _seen(training.setup, training.collector.env, encoder)
    training.evaluation_envs.clear()


# --- files ----------------------------------------------------------------------------------------


def state_dict(training: Training) -> Stored:
    """Return all that the future depends on, as a dictionary of arrays."""
    optional = {
        "memory": named_arrays(training.memory),
        FROZEN: named_arrays(eqx.filter(training.encoder, eqx.is_array)),
    }
    counters = training.counters._asdict()
    return {
        **{name: arrays for name, arrays in optional.items() if arrays},
        "agent": named_arrays(training.arrays),
        "totals": training.totals,
        "replay": named_arrays(training.replay),
        "collector": training.collector.state_dict(),
        "counters": {name: np.array(value) for name, value in counters.items()},
    }


def restore(training: Training, checkpoints: Checkpoints, number: int) -> Training:
    """Return the run as it was at a checkpoint, to be continued bit for bit.

    Raises:
        ConfigurationError: The checkpoint is damaged or belongs to another run.
    """
    checkpoints.check_spec(number, training.env_spec)
    freezing = training.setup.agent.freezing
    if FROZEN in checkpoints.parts(number) and training.encoder is None and freezing:
        encoder, env = freezing.encoder(training.state), training.collector.env
        state = _create(training.setup, _spec(env.goal_spec, encoder))
        training = _begin(training.setup, env, state, encoder, training.counters)
    load_state_dict(training, checkpoints.restore(number, state_dict(training)))
    return training


def load_state_dict(training: Training, state: Stored) -> None:
    """Continue from a ``state_dict``, bit for bit."""
    if training.encoder is not None:
        weights, static = eqx.partition(training.encoder, eqx.is_array)
        encoder = eqx.combine(with_named_arrays(weights, state[FROZEN]), static)
        env = training.collector.env
        training.encoder = encoder
        training.collector.env = _seen(training.setup, freeze.thawed(env), encoder)
    training.arrays = with_named_arrays(training.arrays, state["agent"])
    training.memory = with_named_arrays(training.memory, state.get("memory", {}))
    training.totals = state["totals"]
    replay = with_named_arrays(training.replay, state["replay"])
    training.collector, training.replay = Collector.restore(
        training.collector.env, replay, state["collector"]
    )
    training.collector.limit = training.setup.train.collect_limit
    training.collector.restarts = training.setup.train.on_env_error == RESTART
    fresh = training.begin_episodes(training.setup.train.num_envs)
    training.memory = acting.renew(training.memory, fresh, training.collector.begun)
    counters = state["counters"]
    fields = {name: type(old)(counters[name]) for name, old in Counters()._asdict().items()}
    training.counters = Counters(**fields)
