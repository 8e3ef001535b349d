"""The training loop: collect, update, evaluate, log, checkpoint.

Every random draw of the loop comes from the seed and a counter (steps or updates), so that the
counters are all there is to restore.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np

from midway.replay import buffer
from midway.replay.storage import ReplayState
from midway.training import acting, codes, pretrain
from midway.training import policy as policies
from midway.training import step as steps_of
from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.checkpoint import Checkpoints
from midway.training.collect import Collector
from midway.training.compilation import give_back_memory
from midway.training.devices import Devices
from midway.training.evaluate import ActionKind, Evaluation, run_episodes
from midway.training.folder import RunConfig, RunFolder
from midway.training.logging import Logger
from midway.training.progress import Reporter
from midway.types import Memory, NonFiniteError

EVALUATED_TASKS = ("hard", "uniform")
EVALUATED_ACTIONS: tuple[ActionKind, ...] = ("mean", "sampled")
MOMENTS = 8
"""Moments of training whose weights are kept, for figures of how the subgoals change."""

MakeEnv = Callable[[int, str], Any]
"""``(number of copies, task) -> vector environment``."""


class Training:
    """A run in memory.

    Args:
        agent: The agent's module.
        config: The configuration of the run.
        make_env: Makes its environments.
        folder: Where its files go.
    """

    def __init__(
        self, agent: ModuleType, config: RunConfig, make_env: MakeEnv, folder: RunFolder
    ) -> None:
        self.agent = agent
        self.config = config
        self.folder = folder
        train = config.train
        seeds = np.random.SeedSequence(config.seed).generate_state(4)
        self._env_seed, self._evaluation_seed, self._action_seed = (int(s) for s in seeds[:3])
        self._devices = devices = Devices.first(train.devices)
        keys = devices.copied(jax.random.split(jax.random.key(int(seeds[3])), 4))
        network_key, self._update_key, self._act_key, self._evaluation_key = keys
        self._make_env = make_env
        env = make_env(train.num_envs, train.task)
        self.spec = env.goal_spec
        self._create = partial(
            steps_of.create_state, agent, config.hyperparameters, self.spec, network_key
        )
        arrays, self._static = steps_of.split_state(self._create())
        self.arrays = devices.copied(arrays)
        self._fresh = self.memory = self._begin(train.num_envs)
        replay = devices.allocate(
            partial(buffer.create, self.spec, train.replay_capacity, train.num_envs)
        )
        totals = steps_of.empty_totals(agent, self.arrays, self._static, train, replay)
        self.totals = devices.copied(totals)
        self.learner = steps_of.compile_learner(agent, self._static, train, self.spec, devices)
        self.collector, self.replay = Collector.start(env, replay, self._env_seed)
        self._evaluation_envs: dict[str, Any] = {}
        self.steps = 0
        self.updates = 0
        self.updates_logged = 0
        self.training_seconds = 0.0
        self.seconds = 0.0

    @property
    def state(self) -> Any:
        """The agent's state."""
        return eqx.combine(self.arrays, self._static)

    def pretrain(self, say: Reporter) -> None:
        """Let the agent learn from states before the first step, if it is one that does."""
        state, seconds = pretrain.run(
            self.agent, self.state, self._make_env, self.config.seed, self.folder, say
        )
        self.arrays = self._devices.copied(steps_of.split_state(state)[0])
        self.seconds += seconds

    def _begin(self, episodes: int) -> Memory:
        """Return what the agent remembers at the start of as many episodes."""
        return self._devices.copied(
            acting.begin(self.agent, self.config.hyperparameters, self.spec, episodes)
        )

    # --- one turn of the loop ---------------------------------------------------------------------

    def advance(self) -> None:
        """Take one step in every environment, then the updates that are due."""
        started = time.perf_counter()
        self.replay = self.collector.step(self.replay, self._choose)
        if self.collector.begun.any():
            self.memory = acting.renew(self.memory, self._fresh, self.collector.begun)
        self.steps += self.config.train.num_envs
        per_call = self.config.train.updates_per_call
        while self.config.train.updates_due(self.steps) - self.updates >= per_call:
            self.arrays, self.totals = self.learner.train(
                self.arrays, self.totals, self.replay, self._update_key, self.updates
            )
            self.updates += per_call
        self._leave_images()
        self.training_seconds += time.perf_counter() - started

    def _leave_images(self) -> None:
        """Go on with codes instead of images, if the encoder has just learned its last."""
        if not codes.holds_images(self.replay):
            return
        encoder = codes.encoder_that_stays(self.state, self.updates)
        if encoder is not None:
            self._see_codes(codes.encoded(self.replay, encoder))
            state = codes.begun_again(self._create(), self.state)
            self.arrays = self._devices.copied(steps_of.split_state(state)[0])

    def _see_codes(self, replay: ReplayState) -> None:
        """Collect codes into a replay of codes."""
        encode = self._devices.compile(lambda encoder, images: encoder(images))
        env = codes.CodedEnv(self.collector.env, lambda images: encode(self.state.encoder, images))
        self.replay = replay
        self.collector.env = env
        self.collector.observation = env.see(self.collector.observation)

    def _choose(self, observation: dict[str, Any]) -> Any:
        """Return uniform random actions at first, then sampled actions of the policy."""
        if self.steps < self.config.train.random_steps:
            generator = np.random.default_rng((self._action_seed, self.steps))
            shape = (self.config.train.num_envs, self.spec.action_dim)
            return generator.uniform(-1, 1, shape).astype(np.float32)
        key = jax.random.fold_in(self._act_key, self.steps)
        pair = observation["observation"], observation["desired_goal"]
        actions, self.memory = self.learner.act(self.arrays, self.memory, *pair, key)
        return np.asarray(actions)

    # --- what is looked at from time to time ------------------------------------------------------

    def metrics(self) -> dict[str, float]:
        """Return means since the last call, of updates and of collection; then start anew.

        Raises:
            NonFiniteError: A mean is not finite.
        """
        updates = self.updates - self.updates_logged
        if updates == 0:
            return {}
        values = {name: float(t) / updates for name, t in jax.device_get(self.totals).items()}
        for name, value in values.items():
            if not np.isfinite(value):
                raise NonFiniteError(f"{name} became {value} before step {self.steps}")
        self.totals = jax.tree.map(lambda total: total * 0, self.totals)
        self.updates_logged = self.updates
        return values | self.collector.take_metrics()

    def evaluate(self) -> Iterator[Evaluation]:
        """Yield the evaluations of the current policy, on environments of their own."""
        for task in [task for task in EVALUATED_TASKS if task in self.collector.env.tasks]:
            if task not in self._evaluation_envs:
                episodes = self.config.train.evaluation_episodes
                self._evaluation_envs[task] = self._make_env(episodes, task)
            for actions in EVALUATED_ACTIONS:
                yield run_episodes(
                    self._evaluation_envs[task],
                    self.policy(actions),
                    task,
                    actions,
                    self._evaluation_seed,
                )

    def policy(self, actions: ActionKind) -> Callable[[Any, Any], Any]:
        """Return the current policy, for a batch of observations and goals."""
        act = self.learner.act_mean if actions == "mean" else self.learner.act
        return acting.Actor(partial(act, self.arrays), self._begin, self._evaluation_key)

    # --- files ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return all that the future depends on, as a dictionary of arrays."""
        counters = {
            "steps": self.steps,
            "updates": self.updates,
            "updates_logged": self.updates_logged,
            "training_seconds": self.training_seconds,
            "seconds": self.seconds,
        }
        memory = named_arrays(self.memory)
        return {
            **({"memory": memory} if memory else {}),
            "agent": named_arrays(self.arrays),
            "totals": self.totals,
            "replay": named_arrays(self.replay),
            "collector": self.collector.state_dict(),
            "counters": {name: np.array(value) for name, value in counters.items()},
        }

    def restore(self, checkpoints: Checkpoints, step: int) -> None:
        """Continue from the checkpoint of a step, bit for bit.

        Raises:
            ConfigurationError: The checkpoint is damaged or belongs to another run.
        """
        if codes.holds_codes(self.spec, checkpoints.shape(step, "replay", "rows.observation")):
            self._see_codes(codes.blank(self.replay))
        self.load_state_dict(checkpoints.restore(step, self.state_dict()))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a ``state_dict``, bit for bit."""
        self.arrays = with_named_arrays(self.arrays, state["agent"])
        self.memory = with_named_arrays(self.memory, state.get("memory", {}))
        self.totals = state["totals"]
        replay = with_named_arrays(self.replay, state["replay"])
        self.collector, self.replay = Collector.restore(
            self.collector.env, replay, state["collector"]
        )
        self.memory = acting.renew(self.memory, self._fresh, self.collector.begun)
        counters = state["counters"]
        self.steps = int(counters["steps"])
        self.updates = int(counters["updates"])
        self.updates_logged = int(counters["updates_logged"])
        self.training_seconds = float(counters["training_seconds"])
        self.seconds = float(counters["seconds"])

    def save(self, checkpoints: Checkpoints) -> None:
        """Write a checkpoint and the policy.

        Raises:
            NonFiniteError: A network is not finite; nothing is written then.
        """
        for name, array in named_arrays(self.arrays).items():
            if not bool(np.isfinite(np.asarray(array)).all()):
                raise NonFiniteError(f"{name} is not finite at step {self.steps}")
        checkpoints.save(self.steps, self.state_dict())
        policies.save(self.folder, self.config, self.state, self.steps)


def run(training: Training, checkpoints: Checkpoints, logger: Logger, reporter: Reporter) -> bool:
    """Train until the configured number of steps; return whether it was reached.

    An interrupt (Ctrl-C, or the signal to terminate) ends the run with a checkpoint.

    Raises:
        NonFiniteError: A loss or a network is not finite; the last good checkpoint is kept.
    """
    train = training.config.train
    if training.steps == 0:
        training.pretrain(reporter)
    started = time.perf_counter() - training.seconds
    success: dict[str, float] = {}
    with _interruptible() as interrupted:
        while training.steps < train.steps and not interrupted.is_set():
            before = training.steps
            training.advance()
            done = training.steps >= train.steps

            def every(count: int, before: int = before, done: bool = done) -> bool:
                return done or training.steps // count > before // count

            training.seconds = time.perf_counter() - started
            if every(train.log_every):
                _log(training, logger, reporter, success)
            if every(train.evaluate_every):
                success = _evaluate(training, logger, reporter)
            if every(max(1, train.steps // MOMENTS)):
                policies.keep(training.folder, training.config, training.state, training.steps)
            training.seconds = time.perf_counter() - started
            if every(train.checkpoint_every):
                training.save(checkpoints)
    if training.steps < train.steps:
        training.save(checkpoints)
        reporter.message(f"interrupted: checkpoint of step {training.steps} written")
    return training.steps >= train.steps


def _clock(training: Training) -> dict[str, int | float]:
    return {
        "updates": training.updates,
        "seconds": round(training.seconds, 3),
        "training_seconds": round(training.training_seconds, 3),
    }


def _log(training: Training, logger: Logger, reporter: Reporter, success: dict[str, float]) -> None:
    """Write one row of metrics where there were updates, and say how far the run is.

    This is also a moment to give back memory: programs have been compiled since the last.
    """
    values = training.metrics()
    if values:
        logger.metrics(training.steps, {**_clock(training), **values})
    give_back_memory()
    speed = training.steps / max(training.seconds, 1e-9)
    reporter.advance(training.steps, {"steps/s": speed, **success})


def _evaluate(training: Training, logger: Logger, reporter: Reporter) -> dict[str, float]:
    """Evaluate, write a row for each task and kind of action, and return success by task."""
    success = {}
    for result in training.evaluate():
        logger.evaluation(training.steps, _clock(training), result)
        if result.actions == "mean":
            success[f"success/{result.task}"] = result.success_rate
    reporter.advance(training.steps, success)
    return success


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """Turn the first interrupt into an event; the second one interrupts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    names = (signal.SIGINT, signal.SIGTERM)
    previous = {name: signal.getsignal(name) for name in names}

    def handle(number: int, frame: Any) -> None:
        event.set()
        for name in names:
            signal.signal(name, previous[name])

    for name in names:
        signal.signal(name, handle)
    try:
        yield event
    finally:
        for name in names:
            signal.signal(name, previous[name])
