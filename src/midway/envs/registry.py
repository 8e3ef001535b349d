"""The environments by the names that users type."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from midway.envs.ant_maze import AntMazeVectorEnv
from midway.envs.foreign import Foreign, ForeignVectorEnv, described
from midway.envs.ids import GYM_IDS
from midway.envs.mazes import MAZES
from midway.envs.point_maze import PointMazeVectorEnv
from midway.envs.push import PushStateVectorEnv, PushVectorEnv
from midway.envs.push_scene import TASKS
from midway.envs.sources import UnknownEnvironmentError
from midway.envs.vector import GoalVectorEnv
from midway.types import ConfigurationError


@dataclass(frozen=True)
class Entry:
    """One environment of the registry.

    Attributes:
        name: The name that users type, such as ``ant-u``.
        gym_id: Its Gymnasium id.
        description: One line for lists of environments.
        tasks: Names of the tasks, the training task first.
        factory: ``(num_envs=, task=, num_threads=) -> GoalVectorEnv``.
    """

    name: str
    gym_id: str
    description: str
    tasks: tuple[str, ...]
    factory: Callable[..., GoalVectorEnv]


def _maze_entries(
    robot: str, description: str, factory: Callable[..., GoalVectorEnv]
) -> list[Entry]:
    return [
        Entry(
            name=f"{robot}-{maze.name}",
            gym_id=GYM_IDS[f"{robot}-{maze.name}"],
            description=f"{description} in the {maze.title} maze",
            tasks=tuple(maze.cases),
            factory=partial(factory, maze.name),
        )
        for maze in MAZES.values()
    ]


def _push_entry(name: str, description: str, factory: Callable[..., GoalVectorEnv]) -> Entry:
    return Entry(name, GYM_IDS[name], description, tuple(TASKS), factory)


ENVIRONMENTS: dict[str, Entry] = {
    entry.name: entry
    for entry in [
        *_maze_entries("point", "point mass", PointMazeVectorEnv),
        *_maze_entries("ant", "four-legged ant", AntMazeVectorEnv),
        _push_entry("push", "arm that pushes a puck, seen in images", PushVectorEnv),
        _push_entry("push-state", "the same arm, with states for images", PushStateVectorEnv),
    ]
}
"""Every environment by name, in the order of lists."""


def entry(env: str | Foreign) -> Entry:
    """Return the entry of an environment, of a foreign one too, by its name or as described.

    Raises:
        ConfigurationError: There is none of this name, or midway cannot use it.
    """
    if isinstance(env, Foreign):
        factory = partial(ForeignVectorEnv, env)
        return Entry(env.spec.name, env.spec.name, env.rule.description, ("uniform",), factory)
    if env in ENVIRONMENTS:
        return ENVIRONMENTS[env]
    try:
        return entry(described(env))
    except UnknownEnvironmentError as error:
        own = ", ".join(ENVIRONMENTS)
        raise ConfigurationError(
            f"{error}; midway's own are {own}, and any goal environment goes by its Gymnasium id "
            "or module:name"
        ) from error


def make_vec(
    name: str | Foreign, num_envs: int = 1, task: str = "uniform", num_threads: int = 0
) -> GoalVectorEnv:
    """Return copies of an environment that are stepped together.

    Args:
        name: A name of the registry, such as ``point-u``, or what ``foreign.describe`` returned.
        num_envs: Number of copies.
        task: A task of the environment: what starts and goals are drawn from.
        num_threads: Threads that simulate; 0 chooses. Results do not depend on it.

    Raises:
        ConfigurationError: An unknown name or task, or ``num_envs`` below 1.
    """
    return entry(name).factory(num_envs=num_envs, task=task, num_threads=num_threads)
