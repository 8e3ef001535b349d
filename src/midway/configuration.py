"""From what a user says of an environment, an agent and settings to all that a run is made of."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from midway import presets
from midway.agent import AnyAgent
from midway.agents import registry as agents
from midway.envs import datasets, describing, layouts
from midway.envs import registry as environments
from midway.envs.describing import EnvLike, Foreign, Settings
from midway.envs.registry import Declaration
from midway.errors import ConfigurationError
from midway.runs.folder import RunConfig, RunFolder
from midway.training import state
from midway.types import Trajectory, VectorGoalEnv


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
    return describing.admit(describing.describe(env, said, kwargs, tuple(imports)))


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
    if type(seed) is not int or not 0 <= seed < 2**63:
        raise ConfigurationError(f"seed {seed!r}: must be a whole number from 0 to 2**63 - 1")
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
