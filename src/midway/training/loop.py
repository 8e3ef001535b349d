"""The training loop: collect, update, evaluate, log, checkpoint.

Every random draw comes from the seed and a counter
of steps or updates, so that the counters are all there is to restore.
"""

import time
from collections.abc import Iterator
from functools import partial
from typing import Protocol, TypeAlias, runtime_checkable

import jax
import numpy as np

from midway.errors import BrokenEnvironmentError, NonFiniteError
from midway.training import acting, seeds
from midway.training.arrays import named_arrays
from midway.training.compilation import give_back_memory
from midway.training.evaluate import ActionKind, Evaluation, run_episodes
from midway.training.signals import Asked, Interrupted
from midway.training.state import Counters, Training, freeze_encoder
from midway.types import NumPyArray, Observations

EVALUATED_TASKS = ("hard", "uniform")
EVALUATED_ACTIONS: tuple[ActionKind, ...] = ("mean", "sampled")
SNAPSHOTS = 8
"""Times in a run at which the weights are kept, for figures of how the subgoals change."""

Clock: TypeAlias = dict[str, int | float]


@runtime_checkable
class Sinks(Protocol):
    """Where a run puts what others read: files and messages."""

    def message(self, text: str) -> None:
        """Say one line."""

    def progress(self, step: int, values: dict[str, float]) -> None:
        """Say how far the run is."""

    def metrics(self, step: int, values: dict[str, int | float]) -> None:
        """Take one row of scalars."""

    def evaluation(self, step: int, clock: Clock, results: list[Evaluation]) -> None:
        """Take the results of one evaluation, by task and kind of action."""

    def snapshot(self, training: Training) -> None:
        """Keep the weights of this step."""

    def is_better(self, result: Evaluation) -> bool:
        """Return whether the result is surely better than that of the best policy so far."""

    def best(self, training: Training, confirmed: Evaluation) -> None:
        """Keep the policy as the best, with the result that confirmed it."""

    def checkpoint(self, training: Training) -> None:
        """Write all that the future depends on, and the policy."""

    def watched(self, training: Training) -> bool:
        """Show what was taken last to those who watch; return whether the run ends here."""


# --- one turn of the loop -------------------------------------------------------------------------


def advance(training: Training) -> None:
    """Take one step in every environment, then the updates that are due."""
    started = time.perf_counter()
    train, key = training.setup.train, training.streams.update_key
    if train.collect:
        choose = partial(_choose, training)
        training.replay = training.collector.step(training.replay, choose)
    if (begun := training.collector.begun).any():
        fresh = training.begin_episodes(train.num_envs)
        training.memory = acting.renew(training.memory, fresh, begun)
    if not training.collector.moved:
        return
    steps, updates = training.counters.steps + train.num_envs, training.counters.updates
    spec = training.program.spec
    due, per_call = train.updates_due(steps, spec), train.updates_per_call(spec.is_image)
    stored = training.collector.stored  # updates that are due after a step without wait for one
    while stored and due - updates >= per_call:
        training.arrays, training.totals = training.program.train(
            training.arrays, training.totals, training.replay, key, updates
        )
        updates += per_call
    training.counters = training.counters._replace(steps=steps, updates=updates)
    if spec.is_image and 0 < train.freeze_encoder_after <= updates:
        freeze_encoder(training)
    seconds = training.counters.training_seconds + time.perf_counter() - started
    training.counters = training.counters._replace(training_seconds=seconds)


def _choose(training: Training, observation: Observations) -> NumPyArray:
    """Return uniform random actions at first, then sampled actions of the policy."""
    train, streams, steps = training.setup.train, training.streams, training.counters.steps
    if steps < train.random_steps:
        generator = np.random.default_rng((streams.action, steps))
        shape = (train.num_envs, training.program.spec.action_dim)
        return generator.uniform(-1, 1, shape).astype(np.float32)
    key = jax.random.fold_in(streams.act_key, steps)
    pair = observation["observation"], observation["desired_goal"]
    actions, training.memory = training.program.act(training.arrays, training.memory, *pair, key)
    if not np.isfinite(actions).all():
        raise NonFiniteError(f"the policy's actions are not finite after step {steps}")
    return np.asarray(actions)


# --- what is looked at from time to time ----------------------------------------------------------


def metrics(training: Training) -> dict[str, float]:
    """Return means since the last call, of updates and of collection; then start anew.

    Raises:
        NonFiniteError: A mean is not finite.
    """
    counters = training.counters
    updates = counters.updates - counters.updates_logged
    if updates == 0:
        return {}
    values = {name: float(t) / updates for name, t in jax.device_get(training.totals).items()}
    for name, value in values.items():
        if not np.isfinite(value):
            raise NonFiniteError(f"{name} became {value} before step {counters.steps}")
    training.totals = jax.tree.map(lambda total: total * 0, training.totals)
    training.counters = counters._replace(updates_logged=counters.updates)
    return values | training.collector.take_metrics()


def evaluate(training: Training, asked: Asked) -> Iterator[Evaluation]:
    """Yield the evaluations of the current policy, on environments and episodes of their own.

    Before the first step, the deterministic policy alone is evaluated.

    Raises:
        Interrupted: The run shall end.
        BrokenEnvironmentError: An environment cannot go on.
    """
    kinds = EVALUATED_ACTIONS if training.counters.steps else EVALUATED_ACTIONS[:1]
    for task in [task for task in EVALUATED_TASKS if task in training.collector.env.tasks]:
        for actions in kinds:
            yield _episodes(training, task, actions, asked)


def _episodes(
    training: Training, task: str, actions: ActionKind, asked: Asked, use: int = seeds.EVALUATED
) -> Evaluation:
    """Run episodes that belong to this step and use alone."""
    envs = training.evaluation_envs
    if task not in envs:
        envs[task] = training.make_env(training.setup.train.evaluation_episodes, task)
    seed = training.streams.episodes(training.counters.steps, use)
    return run_episodes(envs[task], policy(training, actions), task, actions, seed, asked.check)


def policy(training: Training, actions: ActionKind) -> acting.Actor:
    """Return the current policy, for observations and goals as the agent sees them."""
    program = training.program
    act = partial(program.act_mean if actions == "mean" else program.act, training.arrays)
    key = jax.random.fold_in(training.streams.evaluation_key, training.counters.steps)
    return acting.Actor(training.setup.agent, act, training.begin_episodes, key)


def check_finite(training: Training) -> None:
    """Check the networks.

    Raises:
        NonFiniteError: One is not finite.
    """
    for name, array in named_arrays(training.arrays).items():
        if not bool(np.isfinite(np.asarray(array)).all()):
            raise NonFiniteError(f"{name} is not finite at step {training.counters.steps}")


# --- the loop -------------------------------------------------------------------------------------


def run(training: Training, sinks: Sinks, asked: Asked | None = None) -> bool:
    """Train until the last step; return whether all of it is done.

    What a signal interrupted in an earlier process is done first.

    Args:
        training: The run.
        sinks: Where its rows, evaluations, snapshots and checkpoints go.
        asked: What signals ask for: a checkpoint, or to end with one.

    Raises:
        NonFiniteError: A loss or a network is not finite; the last good checkpoint is kept.
        BrokenEnvironmentError: An environment cannot go on; a checkpoint is written before.
    """
    train, asked = training.setup.train, asked or Asked()
    started = time.perf_counter() - training.counters.seconds
    success: dict[str, float] = {}
    evaluated = True

    def tick() -> None:
        seconds = time.perf_counter() - started
        training.counters = training.counters._replace(seconds=seconds)

    _stop_at_fault(training, sinks)
    if training.counters.steps == 0:
        take_evaluation(training, sinks, success, asked)
        tick()
    while training.counters.steps < training.last_step and asked.end is None:
        advance(training)
        if training.collector.moved:
            tick()
            if is_due(training, train.log_every):
                _log(training, sinks, success)
            if is_due(training, train.evaluate_every):
                evaluated = take_evaluation(training, sinks, success, asked)
            if is_due(training, max(1, train.steps // SNAPSHOTS)):
                sinks.snapshot(training)
            tick()
            if is_due(training, train.checkpoint_every) or asked.save:
                sinks.checkpoint(training)
            _obey(training, sinks, asked)
        _stop_at_fault(training, sinks)
    finished = training.counters.steps >= training.last_step and evaluated
    if not finished:
        sinks.checkpoint(training)
        sinks.message(f"interrupted: checkpoint of step {training.counters.steps} written")
    return finished


def is_due(training: Training, every: int) -> bool:
    """Return whether the newest step is the last one, or has passed a multiple of ``every``."""
    train, now = training.setup.train, training.counters.steps
    return now >= training.last_step or now // every > (now - train.num_envs) // every


def take_evaluation(
    training: Training, sinks: Sinks, success: dict[str, float], asked: Asked
) -> bool:
    """Evaluate, unless the run shall end; return whether it may go on.

    An environment that cannot go on stops the run only at its last step.
    """
    steps = training.counters.steps
    try:
        success.update(note_evaluation(training, sinks, asked))
    except Interrupted:
        return False
    except BrokenEnvironmentError as fault:
        training.evaluation_envs.clear()
        sinks.message(f"evaluation of step {steps} is left out: {fault}")
        if steps >= training.last_step:
            training.collector.fault = fault
    else:
        _show(training, sinks)
    return True


def _show(training: Training, sinks: Sinks) -> None:
    """Let those who watch see the newest row or evaluations, and end the run if they say so."""
    if sinks.watched(training):
        training.ends_at = training.counters.steps


def _obey(training: Training, sinks: Sinks, asked: Asked) -> None:
    """Say that the checkpoint that a signal asked for is written."""
    if asked.save:
        asked.save = False
        sinks.message(f"checkpoint of step {training.counters.steps} written")


def _stop_at_fault(training: Training, sinks: Sinks) -> None:
    """Write a checkpoint and stop, if an environment cannot go on.

    Raises:
        BrokenEnvironmentError: It cannot.
    """
    if (fault := training.collector.fault) is not None:
        sinks.checkpoint(training)
        raise fault


def _clock(counters: Counters) -> Clock:
    return {
        "updates": counters.updates,
        "seconds": round(counters.seconds, 3),
        "training_seconds": round(counters.training_seconds, 3),
    }


def _log(training: Training, sinks: Sinks, success: dict[str, float]) -> None:
    """Write one row of metrics where there were updates, and say how far the run is.

    This is also when memory is given back: programs have been compiled since the last time.
    """
    values = metrics(training)
    counters = training.counters
    if values:
        sinks.metrics(counters.steps, {**_clock(counters), **values})
    give_back_memory()
    speed = counters.steps / max(counters.seconds, 1e-9)
    sinks.progress(counters.steps, {"steps/s": speed, **success})
    _show(training, sinks)


def note_evaluation(
    training: Training, sinks: Sinks, asked: Asked | None = None
) -> dict[str, float]:
    """Evaluate, write a row for each task and kind of action, and return success by task.

    The policy is kept before the rows are written, all at once: an evaluation that has a row is
    complete.

    Raises:
        Interrupted: The run shall end; nothing is written then.
        BrokenEnvironmentError: An environment cannot go on; nothing is written then.
    """
    counters, success, asked = training.counters, {}, asked or Asked()
    results = list(evaluate(training, asked))
    for shown in results[:1]:
        _keep_the_best(training, sinks, shown, asked)
    sinks.evaluation(counters.steps, _clock(counters), results)
    for result in results:
        if result.actions == "mean":
            success[f"success/{result.task}"] = result.success_rate
    sinks.progress(counters.steps, success)
    return success


def _keep_the_best(training: Training, sinks: Sinks, result: Evaluation, asked: Asked) -> None:
    """Keep the policy if its evaluation and then episodes of its own say that it is the best.

    Of many evaluations the best one was lucky: what counts are the episodes after it.

    Args:
        training: The run.
        sinks: Where the best policy is kept.
        result: Its evaluation on the shown task, with mean actions.
        asked: What signals ask for.

    Raises:
        Interrupted: The run shall end.
        BrokenEnvironmentError: An environment cannot go on.
    """
    if sinks.is_better(result):
        confirmed = _episodes(training, result.task, result.actions, asked, seeds.CONFIRMED)
        if sinks.is_better(confirmed):
            sinks.best(training, confirmed)
