"""The Python interface: train, resume, load, evaluate."""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path

from midway.agent import AnyAgent
from midway.configuration import configure as configure
from midway.configuration import setup_of as setup_of
from midway.envs.describing import EnvLike
from midway.envs.registry import Declaration
from midway.errors import BrokenEnvironmentError, ConfigurationError, NonFiniteError
from midway.runs import complete, kept
from midway.runs import policy as policies
from midway.runs.callbacks import Callback, Watchers
from midway.runs.folder import RunConfig, RunFolder, read_json, run_name
from midway.runs.kept import Which
from midway.runs.place import clear, free_folder
from midway.runs.policy import Policy
from midway.runs.provenance import changed_here
from midway.runs.sinks import RunSinks
from midway.settings import changed
from midway.training import loop, seeds, signals, state
from midway.training.checkpoint import Checkpoints
from midway.training.evaluate import ActionKind, Evaluation, run_episodes
from midway.training.logging import Logger
from midway.training.progress import Reporter, Silent, reporter, stages_of
from midway.training.state import Training


@dataclasses.dataclass(frozen=True)
class Run:
    """What a finished or interrupted run leaves.

    Attributes:
        path: The run folder.
        finished: Whether all steps were taken, or it was ended early as it should be.
        signal: The signal that ended it before, if one did.
    """

    path: Path
    finished: bool
    signal: int | None = None


def train(
    env: EnvLike | Declaration,
    *,
    agent: str | AnyAgent = "ris",
    preset: str = "quick",
    steps: int | None = None,
    seed: int = 0,
    num_envs: int | None = None,
    out: str | Path | None = None,
    precision: str | None = None,
    on_env_error: str | None = None,
    data: str | Path | None = None,
    changes: Mapping[str, object] | None = None,
    progress: bool = False,
    stop_at: float | None = None,
    callbacks: Sequence[Callback] = (),
    overwrite: bool = False,
) -> Run:
    """Train an agent on an environment and write a run folder.

    Args:
        env: Environment name, what `goal_env`, `maze_env` or ``gymnasium.make`` returned, or a
            class or function that makes it.
        agent: ``ris``, ``sac`` and so on, ``package.module:NAME``, or the agent itself.
        preset: ``paper``, ``quick``, or the path of a preset file.
        steps: Environment steps; default: the preset's.
        seed: The one seed of every generator.
        num_envs: Parallel environments; default: the preset's.
        out: The run folder; default: ``runs/ENV-AGENT-seedN``, with a number behind it where that
            is taken.
        precision: ``f32`` or ``bf16``; default: the preset's.
        on_env_error: Where an environment of others raises, hangs, ends its process or shows what
            is not finite: ``stop`` (default) after a checkpoint, or ``restart`` it.
        data: Name or folder of a Minari dataset of this environment, which the replay holds from
            the beginning; with the setting ``collect=False`` nothing else is learned from.
        changes: Other settings, as in `configure`.
        progress: Whether to report on standard error.
        stop_at: Success of the task that is shown (``hard``, if there is one), with mean actions,
            that ends the run once three evaluations in a row have reached it.
        callbacks: Are called after each row of metrics and each evaluation; one that returns True
            ends the run at this step, finished. What they raise ends it too, as a crash would.
        overwrite: Whether a run in the folder is deleted, unless another process trains it.

    Raises:
        ConfigurationError: A name, value or folder cannot be used.
        NonFiniteError: A loss became NaN or infinite; the last good checkpoint is kept.
        BrokenEnvironmentError: An environment raised, or showed what is not finite; a checkpoint
            is written before.
        OSError: A file cannot be written; the checkpoints before are kept.
    """
    named = {"steps": steps, "num_envs": num_envs, "precision": precision, "stop_at": stop_at}
    named |= {"on_env_error": on_env_error}
    given = {name: value for name, value in named.items() if value is not None}
    config = configure(env, agent, preset, seed, {**(changes or {}), **given}, data)
    path = Path("runs") / run_name(config.env, config.agent, seed)
    folder = RunFolder(Path(out or (path if overwrite else free_folder(path))))
    setup = setup_of(config, folder)
    state.check(setup)
    if overwrite:
        clear(folder)
    folder.prepare()
    with folder.lock():
        folder.create(config)
        return _run_locked(config, folder, setup, (progress, callbacks), None)


def resume(
    path: str | Path,
    steps: int | None = None,
    progress: bool = False,
    devices: int | None = None,
    from_step: int | None = None,
    stop_at: float | None = None,
    callbacks: Sequence[Callback] = (),
    on_env_error: str | None = None,
) -> Run:
    """Continue a run from its newest checkpoint, bit for bit.

    A run that was ended early is finished; it goes on if one of steps, step or success is given.

    Args:
        path: The run folder.
        steps: New total of environment steps; default: the run's own.
        progress: Whether to report on standard error.
        devices: New number of accelerators, which changes rounding; default: the run's own.
        on_env_error: ``stop`` or ``restart``, what a broken environment of others does; default:
            as before.
        from_step: Step of an older checkpoint to go on from, 0 to start anew; checkpoints after
            it are renamed and kept.
        stop_at: New success that ends the run; default: the run's own.
        callbacks: As `train`.

    Raises:
        ConfigurationError: This is no run folder, another process trains it, its checkpoint is
            damaged, missing or foreign, or the machine has fewer devices.
        NonFiniteError: A loss became NaN or infinite.
        BrokenEnvironmentError: As `train`.
        OSError: As `train`.
    """
    folder = RunFolder(Path(path))
    folder.load_config()  # a folder that is no run's is refused without a lock in it
    with folder.lock():
        config = folder.load_config()
        folder.check_goes_on()
        new: dict[str, object] = {"steps": steps, "devices": devices}
        new |= {"stop_at": stop_at, "on_env_error": on_env_error}
        given = {name: value for name, value in new.items() if value is not None}
        train = changed(config.train, given)
        goes_on = any(value is not None for value in (steps, stop_at, from_step))
        config = dataclasses.replace(config, train=train)
        number = _chosen(folder, config, from_step)
        setup = setup_of(config, folder)
        state.check(setup)
        if goes_on:
            folder.note_end(None)
        if number is None:
            folder.note_resume(config)
        return _run_locked(config, folder, setup, (progress, callbacks), number)


def load(
    path: str | Path, policy: Which = "last", changes: Mapping[str, object] | None = None
) -> Policy:
    """Return the policy of a run: ``policy(observation, goal) -> action``.

    Args:
        path: The run folder.
        policy: ``last``, ``best``, or an environment step whose policy was kept.
        changes: Settings that the policy acts with, as in `Policy.using`.

    Raises:
        ConfigurationError: The folder holds no such policy, or a damaged or foreign one, or a
            setting may not change after training.
    """
    folder = RunFolder.at(path)
    return policies.load(folder, kept.weights_of(folder, policy)).using(changes or {})


def evaluate(
    path: str | Path,
    *,
    episodes: int = 100,
    task: str | None = None,
    actions: ActionKind = "mean",
    seed: int = 0,
    policy: Which = "last",
    changes: Mapping[str, object] | None = None,
) -> Evaluation:
    """Run episodes of a trained policy.

    Args:
        path: The run folder.
        episodes: Number of episodes.
        task: ``hard``, ``uniform`` or a named case of the environment; default: ``hard`` where
            there is one, else the environment's own starts and goals.
        actions: ``mean`` or ``sampled``.
        seed: Seed of starts and goals, which no training meets.
        policy: As in `load`.
        changes: As in `load`.

    Raises:
        ConfigurationError: The folder, policy, task, setting or number of episodes cannot be used.
    """
    if episodes < 1:
        raise ConfigurationError(f"episodes {episodes}: must be at least 1")
    loaded = load(path, policy, changes)
    declared = loaded.config.declaration()
    task = task or declared.shown_task
    env = declared.factory(num_envs=episodes, task=task)
    told = stages_of("steps of the episodes", loaded.spec.max_episode_steps)
    start = seeds.evaluation(seed)
    return run_episodes(env, loaded.actor(actions, seed), task, actions, start, told)


def _chosen(folder: RunFolder, config: RunConfig, from_step: int | None) -> int | None:
    """Return the step of the whole checkpoint to go on from; None to begin at the beginning.

    Raises:
        ConfigurationError: That checkpoint is damaged or foreign, or there is none any more.
    """
    if from_step == 0:
        return None
    number = Checkpoints(folder.checkpoints, folder.owner(config)).choose(from_step)
    if number is None and complete.had_checkpoint(folder, config):
        raise ConfigurationError(
            f"run folder {folder.path}: its checkpoints are gone; to start anew: "
            f"midway resume {folder.path} --from 0"
        )
    return number


def _run_locked(
    config: RunConfig,
    folder: RunFolder,
    setup: state.Setup,
    watched: tuple[bool, Sequence[Callback]],
    number: int | None,
) -> Run:
    """Restore the checkpoint of a step, if one is given; then train.

    Args:
        config: The configuration of the run.
        folder: Its folder.
        setup: What it is made of.
        watched: Whether to report on standard error, and the callbacks.
        number: Step of the checkpoint.

    Raises:
        NonFiniteError: As `train`, with what is there to go on from.
    """
    folder.remove_unfinished()
    checkpoints = Checkpoints(folder.checkpoints, folder.owner(config))
    checkpoints.remove_unfinished()
    progress, callbacks = watched
    say: Reporter = reporter(config.train.steps, number or 0) if progress else Silent()
    watchers = Watchers(config, folder, callbacks)
    try:
        with signals.listening() as asked, closing(say):
            try:
                parts = checkpoints, say, watchers
                finished = _run(config, folder, setup, parts, number, asked)
            except signals.Interrupted:
                say.message(f"{folder.path}: interrupted before its first step")
                finished = False
            return Run(folder.path, finished, None if finished else asked.end)
    except (NonFiniteError, BrokenEnvironmentError) as error:
        raise type(error)(f"{error}; {complete.left(folder)}") from error


def _run(
    config: RunConfig,
    folder: RunFolder,
    setup: state.Setup,
    parts: tuple[Checkpoints, Reporter, Watchers],
    number: int | None,
    asked: signals.Asked,
) -> bool:
    """Restore and train; return whether the run is finished.

    Raises:
        Interrupted: A signal ended it before its first step.
    """
    checkpoints, say, watchers = parts
    if rule := config.rule_of_success:
        say.message(rule)
    training = state.start(setup, say.message if number is None else None, asked.check)
    if number is not None:
        training = state.restore(training, checkpoints, number)
        with suppress(KeyError, TypeError, IndexError):  # a record that somebody has edited
            if differs := changed_here(read_json(folder.config_file)):
                say.message(differs)
        folder.note_resume(config)
    else:
        folder.best_weights.unlink(missing_ok=True)
    steps, training.ends_at = training.counters.steps, folder.ended_at()
    checkpoints.set_aside_after(steps)
    checkpoints.remove_old()  # a process may have been killed before it did
    files = folder.metrics_file, folder.evaluation_file, folder.path / "events"
    with closing(Logger(*files, steps, say.message)) as logger:
        sinks = RunSinks(config, folder, logger, checkpoints, say, watchers)
        if number is not None:
            _complete(training, sinks, folder, asked)
        return loop.run(training, sinks, asked)


def _complete(training: Training, sinks: RunSinks, folder: RunFolder, asked: signals.Asked) -> None:
    """Write what a process that was ended, or somebody, left out beside the checkpoint.

    Raises:
        Interrupted: A signal ended the evaluation again.
    """
    steps, train = training.counters.steps, training.setup.train
    if complete.policy_step(folder) != steps:
        sinks.policy(training)
    due = steps > 0 and loop.is_due(training, train.evaluate_every)
    if due and not complete.is_evaluated(folder, steps):
        loop.take_evaluation(training, sinks, {}, asked)
        asked.check()
