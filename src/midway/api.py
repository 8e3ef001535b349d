"""The Python interface: train, resume, load, evaluate."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from midway import presets
from midway.agent import AnyAgent
from midway.agents import registry as agents
from midway.envs import datasets, foreign, layouts
from midway.envs import registry as environments
from midway.envs.foreign import EnvLike, Foreign, Settings
from midway.envs.registry import Declaration
from midway.errors import BrokenEnvironmentError, ConfigurationError, NonFiniteError
from midway.runs import complete
from midway.runs import policy as policies
from midway.runs.folder import RunConfig, RunFolder, run_name
from midway.runs.policy import Policy
from midway.training import loop, seeds, signals, state
from midway.training.checkpoint import Checkpoints, steps_in
from midway.training.evaluate import ActionKind, Evaluation, run_episodes
from midway.training.logging import Logger
from midway.training.progress import Reporter, Silent, reporter
from midway.training.state import Training
from midway.types import Trajectory, VectorGoalEnv


@dataclasses.dataclass(frozen=True)
class Run:
    """What a finished or interrupted run leaves.

    Attributes:
        path: The run folder.
        finished: Whether all steps were taken.
        signal: The signal that ended it before, if one did.
    """

    path: Path
    finished: bool
    signal: int | None = None


def goal_env(
    env: EnvLike,
    *,
    success_distance: float | None = None,
    success_function: str | Callable[..., object] | None = None,
    max_episode_steps: int | None = None,
    action_bound: float | None = None,
    step_seconds: float = Settings.step_seconds,
    kwargs: Mapping[str, object] | None = None,
    imports: Sequence[str] = (),
) -> Foreign:
    """Return an environment that is not midway's, with what midway must be told of it.

    Args:
        env: ``Id``, ``module:Id``, ``module:callable``, what ``gymnasium.make`` returned, or a
            class or function that makes it.
        success_distance: Distance between the goals below which one counts as reached.
        success_function: Function of achieved and desired goals that says so, or its
            ``module:function``.
        max_episode_steps: Steps of an episode, in place of the registered limit.
        action_bound: Bounds of actions that have none.
        step_seconds: Seconds that a step or a reset of all copies may take where other processes
            step them: one that takes longer is taken for hanging.
        kwargs: Keyword arguments of the environment.
        imports: Modules to import first, which register environments.

    Raises:
        ConfigurationError: It cannot be made, is no goal environment, has no limit, or does not
            say when a goal is reached; the text says what to give.
    """
    said = Settings(
        success_distance, success_function, max_episode_steps, action_bound, step_seconds
    )
    return foreign.admit(foreign.describe(env, said, kwargs, tuple(imports)))


def maze_env(robot: str, maze: str | Path) -> Declaration:
    """Return an environment of a robot in a maze of one's own, for `train` and `make_vec`.

    Args:
        robot: ``point`` or ``ant``.
        maze: A file of letters (``#`` wall, ``.`` free, ``S`` start and ``G`` goal of the hard
            task), or of YAML with them as ``map`` and the side of a cell as ``cell`` (m); or
            ``umaze`` or ``medium``, which are gymnasium-robotics'.

    Raises:
        ConfigurationError: There is no such robot, or the file holds no map of a maze.
    """
    return environments.own_maze(robot, layouts.read(maze))


def configure(
    env: EnvLike | Declaration,
    agent: str | AnyAgent = "ris",
    preset: str = "quick",
    seed: int = 0,
    changes: Mapping[str, object] | None = None,
    data: str | Path | None = None,
) -> RunConfig:
    """Return a preset with some values changed.

    Args:
        env: Environment name, another environment, or its declaration.
        agent: Agent name, ``package.module:NAME``, or the agent itself.
        preset: ``paper``, ``quick``, or the path of a preset file.
        seed: The one seed of every generator, from 0.
        changes: Values by their field names in `TrainConfig` or the agent's ``Config``; text is
            read as Python literals.
        data: Name or folder of a Minari dataset.

    Raises:
        ConfigurationError: A name is unknown or a value is not allowed.
    """
    name = agents.name_of(agent)
    declared = environments.entry(env)
    resolved = presets.resolve(declared, name, preset, changes)
    parts = (preset, seed, resolved.train, resolved.hyperparameters)
    return RunConfig(
        declared.name,
        name,
        *parts,
        foreign=declared.foreign.stored if declared.foreign else None,
        maze={"robot": declared.family, **declared.layout.to_json()} if declared.layout else None,
        data=None if data is None else str(data),
    )


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
        out: The run folder; default: ``runs/ENV-AGENT-seedN``.
        precision: ``f32`` or ``bf16``; default: the preset's.
        on_env_error: Where an environment of others raises, hangs, ends its process or shows what
            is not finite: ``stop`` (default) after a checkpoint, or ``restart`` it.
        data: Name or folder of a Minari dataset of this environment, which the replay holds from
            the beginning; with the setting ``collect=False`` nothing else is learned from.
        changes: Other settings, as in `configure`.
        progress: Whether to report on standard error.

    Raises:
        ConfigurationError: A name, value or folder cannot be used.
        NonFiniteError: A loss became NaN or infinite; the last good checkpoint is kept.
        BrokenEnvironmentError: An environment raised, or showed what is not finite; a checkpoint
            is written before.
        OSError: A file cannot be written; the checkpoints before are kept.
    """
    named = {"steps": steps, "num_envs": num_envs, "precision": precision}
    named |= {"on_env_error": on_env_error}
    given = {name: value for name, value in named.items() if value is not None}
    config = configure(env, agent, preset, seed, {**(changes or {}), **given}, data)
    folder = RunFolder(Path(out or Path("runs") / run_name(config.env, config.agent, seed)))
    setup = setup_of(config, folder)
    state.check(setup)
    folder.prepare()
    with folder.lock():
        folder.create(config)
        return _run_locked(config, folder, setup, progress, None)


def resume(
    path: str | Path,
    steps: int | None = None,
    progress: bool = False,
    devices: int | None = None,
    from_step: int | None = None,
    on_env_error: str | None = None,
) -> Run:
    """Continue a run from its newest checkpoint, bit for bit.

    Args:
        path: The run folder.
        steps: New total of environment steps; default: the run's own.
        progress: Whether to report on standard error.
        devices: New number of accelerators, which changes rounding; default: the run's own.
        on_env_error: ``stop`` or ``restart``, what a broken environment of others does; default:
            as before.
        from_step: Step of an older checkpoint to go on from, 0 to start anew; checkpoints after
            it are renamed and kept.

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
        train = dataclasses.replace(
            config.train,
            steps=config.train.steps if steps is None else int(steps),
            devices=config.train.devices if devices is None else int(devices),
            on_env_error=on_env_error or config.train.on_env_error,
        )
        config = dataclasses.replace(config, train=train)
        number = _chosen(folder, config, from_step)
        setup = setup_of(config, folder)
        state.check(setup)
        if number is None:
            folder.note_resume(config)
        return _run_locked(config, folder, setup, progress, number)


def load(path: str | Path) -> Policy:
    """Return the policy of a run: ``policy(observation, goal) -> action``.

    Raises:
        ConfigurationError: The folder holds no policy, or a damaged or foreign one.
    """
    return policies.load(RunFolder(Path(path)))


def evaluate(
    path: str | Path,
    *,
    episodes: int = 100,
    task: str | None = None,
    actions: ActionKind = "mean",
    seed: int = 0,
) -> Evaluation:
    """Run episodes of a trained policy.

    Args:
        path: The run folder.
        episodes: Number of episodes.
        task: ``hard``, ``uniform`` or a named case of the environment; default: ``hard`` where
            there is one, else the environment's own starts and goals.
        actions: ``mean`` or ``sampled``.
        seed: Seed of starts and goals.

    Raises:
        ConfigurationError: The folder, the task or the number of episodes cannot be used.
    """
    if episodes < 1:
        raise ConfigurationError(f"episodes {episodes}: must be at least 1")
    policy = load(path)
    declared = policy.config.declaration()
    task = task or declared.shown_task
    env = declared.factory(num_envs=episodes, task=task)
    return run_episodes(env, policy.actor(actions, seed), task, actions, seeds.evaluation(seed))


def setup_of(config: RunConfig, folder: RunFolder) -> state.Setup:
    """Return what the run of this configuration is made of; nothing is written."""
    declared = config.declaration()

    def make_env(num_envs: int, task: str) -> VectorGoalEnv:
        return declared.factory(num_envs=num_envs, task=task)

    agent = agents.get(config.agent)
    parts = (config.hyperparameters, config.train, config.seed, make_env, folder.path)
    return state.Setup(agent, *parts, _demonstrations(config, declared))


def _demonstrations(
    config: RunConfig, declared: Declaration
) -> Callable[[], Iterable[Trajectory]] | None:
    """Return what reads the trajectories of others that a run begins with.

    Raises:
        ConfigurationError: None are given where no step is taken, or for one of midway's own.
    """
    if config.data is None:
        if not config.train.collect:
            raise ConfigurationError("collect False: without --data there is nothing to learn from")
        return None
    if declared.foreign is None:
        raise ConfigurationError(f"--data {config.data}: not for midway's own environments")
    return partial(datasets.trajectories, config.data, declared.foreign)


class RunSinks:
    """Puts what a run says into its folder, and on the terminal.

    Args:
        config: The configuration of the run.
        folder: Its folder.
        logger: Its CSV and TensorBoard files.
        checkpoints: Its checkpoints.
        say: Its terminal.
    """

    def __init__(
        self,
        config: RunConfig,
        folder: RunFolder,
        logger: Logger,
        checkpoints: Checkpoints,
        say: Reporter,
    ) -> None:
        self._config = config
        self._folder = folder
        self._checkpoints = checkpoints
        self.message, self.progress = say.message, say.advance
        self.metrics, self.evaluation = logger.metrics, logger.evaluation

    def snapshot(self, training: Training) -> None:
        """Keep the weights of this step, for figures."""
        policies.keep(self._folder, self._config, training)

    def checkpoint(self, training: Training) -> None:
        """Write a checkpoint and the policy.

        Raises:
            NonFiniteError: A network is not finite; nothing is written then.
        """
        loop.check_finite(training)
        stored = state.state_dict(training)
        self._checkpoints.save(training.counters.steps, stored, training.env_spec)
        self.policy(training)

    def policy(self, training: Training) -> None:
        """Write the policy."""
        policies.save(self._folder, self._config, training)


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
    config: RunConfig, folder: RunFolder, setup: state.Setup, progress: bool, number: int | None
) -> Run:
    """Restore the checkpoint of a step, if one is given; then train.

    Raises:
        NonFiniteError: As `train`, with what is there to go on from.
    """
    folder.remove_unfinished()
    checkpoints = Checkpoints(folder.checkpoints, folder.owner(config))
    checkpoints.remove_unfinished()
    say: Reporter = reporter(config.train.steps, number or 0) if progress else Silent()
    try:
        with signals.listening() as asked, closing(say), closing(checkpoints):
            try:
                finished = _run(config, folder, setup, (checkpoints, say), number, asked)
            except signals.Interrupted:
                say.message(f"{folder.path}: interrupted before its first step")
                finished = False
            return Run(folder.path, finished, None if finished else asked.end)
    except (NonFiniteError, BrokenEnvironmentError) as error:
        raise type(error)(f"{error}; {_kept(folder)}") from error


def _run(
    config: RunConfig,
    folder: RunFolder,
    setup: state.Setup,
    parts: tuple[Checkpoints, Reporter],
    number: int | None,
    asked: signals.Asked,
) -> bool:
    """Restore and train; return whether the run is finished.

    Raises:
        Interrupted: A signal ended it before its first step.
    """
    checkpoints, say = parts
    if rule := config.rule_of_success:
        say.message(rule)
    training = state.start(setup, say.message if number is None else None, asked.check)
    if number is not None:
        training = state.restore(training, checkpoints, number)
        folder.note_resume(config)
    steps = training.counters.steps
    checkpoints.set_aside_after(steps)
    files = folder.metrics_file, folder.evaluation_file, folder.path / "events"
    with closing(Logger(*files, steps, say.message)) as logger:
        sinks = RunSinks(config, folder, logger, checkpoints, say)
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
    due = loop.is_due(training, train.evaluate_every)
    if due and not complete.is_evaluated(folder, steps):
        loop.take_evaluation(training, sinks, {}, asked)
        asked.check()


def _kept(folder: RunFolder) -> str:
    """Return what a run that was stopped can go on from."""
    newest = max(steps_in(folder.checkpoints), default=None)
    if newest is None:
        return "there is no checkpoint yet"
    return f"go on from the checkpoint of step {newest}: midway resume {folder.path}"
