"""The environments by the names that users type: one declaration each."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import gymnasium

from midway.envs.mazes import MAZES, Maze
from midway.envs.views import MazeView, TableView, View
from midway.errors import ConfigurationError

if TYPE_CHECKING:
    from midway.envs.describing import EnvLike, Foreign
    from midway.envs.layouts import Layout
    from midway.envs.vector import GoalVectorEnv


@dataclass(frozen=True)
class Declaration:
    """All that the package knows of an environment before it is made.

    Attributes:
        name: The name that users type, such as ``ant-u``.
        gym_id: Its Gymnasium id.
        family: What it has in common with others: ``point``, ``ant``, ``push`` or ``other``.
        description: One line for lists of environments.
        tasks: Names of the tasks, the training task first.
        entry_point: ``module:class`` of its vector environment, imported when it is made.
        arguments: Arguments of that class besides ``num_envs``, ``task`` and ``num_threads``.
        view: How it is drawn from above, if it is.
        steps: Environment steps of the preset ``quick``.
        layout: The letters that a maze of one's own was drawn with.
    """

    name: str
    gym_id: str
    family: str
    description: str
    tasks: tuple[str, ...]
    entry_point: str
    arguments: dict[str, object] = field(default_factory=dict, hash=False)
    view: View | None = None
    steps: int = 32_000
    layout: "Layout | None" = None

    @property
    def foreign(self) -> "Foreign | None":
        """What was decided about an environment that is not midway's."""
        return cast("Foreign | None", self.arguments.get("foreign"))

    @property
    def shown_task(self) -> str:
        """The task that is evaluated and shown if none is named: the hard one, if there is one."""
        return "hard" if "hard" in self.tasks else self.tasks[0]

    def factory(
        self, num_envs: int = 1, task: str = "uniform", num_threads: int = 0, **others: object
    ) -> "GoalVectorEnv":
        """Return environments that are stepped together, as `make_vec`; others are its class's."""
        module, name = self.entry_point.split(":")
        made: Callable[..., GoalVectorEnv] = getattr(importlib.import_module(module), name)
        options = {"num_envs": num_envs, "task": task, "num_threads": num_threads, **others}
        return made(**self.arguments, **options)


def _in_mazes(
    family: str, robot: str, entry_point: str, upright: tuple[int, int] | None, budgets: list[int]
) -> list[Declaration]:
    """Declare a robot in each maze; the budgets are those of the mazes in order."""
    title = f"{family.capitalize()}Maze"

    def declare(maze: Maze, steps: int) -> Declaration:
        return Declaration(
            name=f"{family}-{maze.name}",
            gym_id=f"midway/{title}-{maze.name.capitalize()}-v0",
            family=family,
            description=f"{robot} in the {maze.title} maze",
            tasks=tuple(maze.cases),
            entry_point=entry_point,
            arguments={"maze": maze.name},
            view=MazeView(maze, upright),
            steps=steps,
        )

    return [declare(maze, steps) for maze, steps in zip(MAZES.values(), budgets, strict=True)]


def _push(name: str, gym_id: str, description: str, kind: str, steps: int) -> Declaration:
    return Declaration(
        name=name,
        gym_id=gym_id,
        family="push",
        description=description,
        tasks=("uniform", "hard", "near"),
        entry_point=f"midway.envs.push:{kind}",
        view=TableView(),
        steps=steps,
    )


POINT = "midway.envs.point_maze:PointMazeVectorEnv"
ANT = "midway.envs.ant_maze:AntMazeVectorEnv"
IMAGES, STATES = "arm that pushes a puck, seen in images", "the same arm, with states for images"

ENVIRONMENTS: dict[str, Declaration] = {
    declared.name: declared
    for declared in [
        *_in_mazes("point", "point mass", POINT, None, [32_000, 32_000, 32_000, 48_000]),
        *_in_mazes("ant", "four-legged ant", ANT, (5, 7), [160_000, 240_000, 400_000, 400_000]),
        _push("push", "midway/Push-v0", IMAGES, "PushVectorEnv", 400_000),
        _push("push-state", "midway/PushState-v0", STATES, "PushStateVectorEnv", 100_000),
    ]
}
"""Every environment of this package by name, in the order of lists."""


def own_maze(robot: str, layout: "Layout") -> Declaration:
    """Return the declaration of a robot in a maze of one's own.

    Episodes are those of the U-shaped maze, the budget is that of the Π-shaped one, which is harder
    to learn; both grow with the way of the hard task.

    Args:
        robot: ``point`` or ``ant``.
        layout: The maze.

    Raises:
        ConfigurationError: There is no such robot.
    """
    if robot not in ROBOTS:
        raise ConfigurationError(f"--maze goes with {' or '.join(ROBOTS)}, not with {robot}")
    entry_point, limit, upright, title = ROBOTS[robot]
    maze, longer = layout.maze(), max(1.0, layout.length / WAY_OF_U)
    return Declaration(
        name=f"{robot}-{layout.name}",
        gym_id="",
        family=robot,
        description=f"{title} in a maze of one's own",
        tasks=tuple(maze.cases),
        entry_point=entry_point,
        arguments={"maze": maze, "max_episode_steps": 10 * round(limit * longer / 10)},
        view=MazeView(maze, upright),
        steps=1_000 * round(ENVIRONMENTS[f"{robot}-pi"].steps * longer / 1_000),
        layout=layout,
    )


def register_ids() -> None:
    """Register every environment with Gymnasium, single and vector."""
    for name, declared in ENVIRONMENTS.items():
        gymnasium.register(
            id=declared.gym_id,
            entry_point="midway.envs.single:SingleGoalEnv",
            vector_entry_point="midway.envs.registry:make_vec",
            kwargs={"name": name},
        )


ROBOTS = {
    "point": (POINT, 150, None, "point mass"),
    "ant": (ANT, 600, (5, 7), "four-legged ant"),
}
"""Entry point, steps of an episode in the U-shaped maze, `MazeView.upright`, and title."""

WAY_OF_U = 21.0
"""Way from start to goal of the hard task of the U-shaped maze (m)."""


def entry(env: "EnvLike | Declaration") -> Declaration:
    """Return the declaration of an environment.

    Raises:
        ConfigurationError: There is none of this name, or midway cannot use it.
    """
    if isinstance(env, Declaration):
        return env
    if isinstance(env, str) and env in ENVIRONMENTS:
        return ENVIRONMENTS[env]
    from midway.envs import describing, sources

    try:
        described = env if isinstance(env, describing.Foreign) else describing.described(env)
    except sources.UnknownEnvironmentError as error:
        raise ConfigurationError(
            f"{error}; midway's own are {', '.join(ENVIRONMENTS)}, and any goal environment goes "
            "by its Gymnasium id or module:name"
        ) from error
    return Declaration(
        name=described.spec.name,
        gym_id=described.source.reference,
        family="other",
        description=described.rule.description,
        tasks=("uniform",),
        entry_point="midway.envs.foreign:ForeignVectorEnv",
        arguments={"foreign": described},
    )


def make_vec(
    name: "EnvLike | Declaration", num_envs: int = 1, task: str = "uniform", num_threads: int = 0
) -> "GoalVectorEnv":
    """Return environments that are stepped together.

    Args:
        name: A name of the registry, such as ``point-u``, or another environment.
        num_envs: Number of environments.
        task: A task of the environment: what starts and goals are drawn from.
        num_threads: Threads that simulate; 0 chooses. Results do not depend on it.

    Raises:
        ConfigurationError: An unknown name or task, or ``num_envs`` below 1.
    """
    return entry(name).factory(num_envs, task, num_threads)
