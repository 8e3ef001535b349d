"""What the saved policy of a run does and imagines in its maze, computed once and kept as CSV."""

import csv
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from midway.envs import registry as environments
from midway.envs.geodesic import geodesic_distance
from midway.envs.mazes import MAZES, ROBOT_RADIUS, Maze
from midway.reports import imagination
from midway.reports.rollouts import Recording, record
from midway.reports.runs import RunData, Table, read_table
from midway.training import policy as policies
from midway.training.folder import RunFolder
from midway.training.policy import Policy
from midway.types import ConfigurationError

SEED = 20_210_718
"""Seed of starts and goals in figures: the same for every run, and met in no training."""

VERSION = 2
"""Counted up when the same policy would give other tables."""

STEPS = 30_000
"""About how many steps the episodes on uniform tasks may take together."""

PATH_POINTS = 100
"""Positions that are kept of an episode, at most."""

POSITION = slice(0, 2)
"""x and y in the observations and goals of every maze (m)."""

COSINES = (5, 7)
"""Cosines of pitch and roll in the observation of the ant; up points along their product."""

CHAIN_DEPTH = 3
MOMENTS = 4
"""Moments of training that subgoals are shown of, at most."""

SPACING = 0.25
"""Distance between points of the value map (m)."""


@dataclass(frozen=True)
class Episode:
    """One episode in a maze.

    Attributes:
        task: What start and goal were drawn from.
        path: Positions from the start on ``(T, 2)`` (m).
        goal: Position of the goal (m).
        success: Whether the goal was reached.
        geodesic: Length of the shortest path from start to goal (m).
        flipped: Whether an ant lay on its back at the end.
    """

    task: str
    path: Float[np.ndarray, "T 2"]
    goal: Float[np.ndarray, "2"]
    success: bool
    geodesic: float
    flipped: bool = False


@dataclass(frozen=True)
class PastRun(RunFolder):
    """A run folder as it was when other weights were saved."""

    weights: Path

    @property
    def policy_weights(self) -> Path:
        """The weights of that moment."""
        return self.weights


def maze_of(env: str) -> Maze | None:
    """Return the maze of an environment such as ``ant-u``; None if it has none."""
    return MAZES.get(env.partition("-")[2])


class Study:
    """The tables of one run; each is a file, which a second report reads instead.

    The file names hold a digest of the weights: another policy has other files.

    Args:
        run: A run in a maze with a saved policy.
        folder: Where the tables are kept.

    Raises:
        ConfigurationError: The environment has no maze; later: the policy is damaged or foreign.
    """

    def __init__(self, run: RunData, folder: Path) -> None:
        maze = maze_of(run.config.env)
        if maze is None:
            raise ConfigurationError(f"{run.config.env} has no maze")
        self.run = run
        self.maze = maze
        self._folder = folder
        self._loaded: dict[Path, Policy] = {}

    @property
    def imagines(self) -> bool:
        """Whether the agent has a policy over subgoals."""
        return imagination.imagines(self.run.config.agent)

    @property
    def plans(self) -> bool:
        """Whether the agent plans subgoals."""
        return imagination.plans(self.run.config.agent)

    @property
    def judges(self) -> bool:
        """Whether the agent has a value of a state and a goal."""
        return imagination.judges(self.run.config.agent)

    @property
    def policy(self) -> Policy:
        """The saved policy."""
        return self._policy_of(self.run.folder.policy_weights)

    @property
    def value_unit(self) -> str:
        """What the values of this agent are."""
        if hasattr(self.run.config.hyperparameters, "discount"):
            return "value: minus discounted steps to the goal"
        return "value: minus distance left at the horizon"

    def episodes(self) -> list[Episode]:
        """Return episodes of every task with mean actions."""
        recordings: list[Recording] = []

        def recorded() -> list[Recording]:
            if not recordings:
                recordings.extend(record(self.policy, self._counts(), SEED))
            return recordings

        table = self._table("episodes", lambda: _episode_table(recorded(), self.maze))
        paths = self._table("paths", lambda: _path_table(recorded()))
        bounds = np.searchsorted(paths["episode"], np.arange(len(table["task"]) + 1))
        positions = np.stack([paths["x"], paths["y"]], axis=1)
        return [
            Episode(
                task=str(table["task"][i]),
                path=positions[bounds[i] : bounds[i + 1]],
                goal=np.array([table["goal_x"][i], table["goal_y"][i]]),
                success=bool(table["success"][i]),
                geodesic=float(table["geodesic"][i]),
                flipped=bool(table["flipped"][i]),
            )
            for i in range(len(table["task"]))
        ]

    def subgoals(self) -> Table:
        """Return location and scale of the subgoals of the hard task, a row for each moment."""
        weights = self._moments()

        def compute() -> Table:
            start, goal = self._hard_pair()
            rows = []
            for step, file in weights.items():
                pair = imagination.distribution(self._policy_of(file), start[None], goal[None])
                ends = (start[POSITION], goal[POSITION])
                rows.append([step, *np.ravel([*ends, *(p[0, POSITION] for p in pair)])])
            names = ("step", "start_x", "start_y", "goal_x", "goal_y", "x", "y", "scale_x")
            return dict(zip((*names, "scale_y"), np.array(rows, np.float64).T, strict=True))

        return self._table("subgoals", compute, *weights.values())

    def chain(self) -> Table:
        """Return the positions of the subgoal chain of the hard task."""

        def compute() -> Table:
            way = imagination.chain(self.policy, *self._hard_pair(), CHAIN_DEPTH)
            return {"x": way[:, 0].astype(np.float64), "y": way[:, 1].astype(np.float64)}

        return self._table("chain", compute)

    def plan(self) -> Table:
        """Return the positions of the subgoals that are planned for the hard task."""

        def compute() -> Table:
            start, goal = self._hard_pair()
            way = np.stack([start, *imagination.first_plan(self.policy, start, goal), goal])
            x, y = way[:, POSITION].T.astype(np.float64)
            return {"x": x, "y": y}

        return self._table("plan", compute)

    def values(self) -> Table:
        """Return the value of the goal of the hard task at points all over the arena."""

        def compute() -> Table:
            start, goal = self._hard_pair()
            x, y = grid(self.maze)
            points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            observations = np.repeat(start[None], len(points), axis=0)
            observations[:, POSITION] = points
            goals = np.repeat(goal[None], len(points), axis=0)
            value = imagination.values(self.policy, observations, goals)
            return {"x": points[:, 0], "y": points[:, 1], "value": value.astype(np.float64)}

        return self._table("values", compute)

    def _policy_of(self, weights: Path) -> Policy:
        if weights not in self._loaded:
            spec = environments.make_vec(self.run.config.env).goal_spec
            self._loaded[weights] = policies.load(PastRun(self.run.folder.path, weights), spec)
        return self._loaded[weights]

    def _moments(self) -> dict[int, Path]:
        """Return weights by step: some of the past, and the newest."""
        past = self.run.past_weights
        chosen = np.linspace(0, len(past) - 1, min(len(past), MOMENTS - 1)).round().astype(int)
        earlier = {step: past[step] for step in np.array(list(past))[chosen].tolist()}
        return {**earlier, self.run.policy_step: self.run.folder.policy_weights}

    def _counts(self) -> dict[str, int]:
        """Return the number of episodes of each task: more where they are short."""
        uniform = int(np.clip(STEPS // self.policy.state.spec.max_episode_steps, 20, 200))
        named = int(np.clip(uniform // 6, 8, 20))
        return {task: uniform if task == "uniform" else named for task in self.maze.cases}

    def _hard_pair(self) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
        """Return start and goal in the middle of the boxes of the hard task."""
        case = self.maze.cases["hard"]
        boxes = {"start": (case.start.x, case.start.y), "goal": (case.goal.x, case.goal.y)}
        env = environments.make_vec(self.run.config.env)
        observation, _ = env.reset(seed=SEED, options={"task": "hard", **boxes})
        return observation["observation"][0], observation["desired_goal"][0]

    def _table(self, name: str, compute: Callable[[], Table], *weights: Path) -> Table:
        """Return a table from its file, or compute it and write the file."""
        digest = hashlib.sha256(f"{VERSION} {SEED} {self.maze}".encode())
        for file in (self.run.folder.policy_weights, *weights):
            digest.update(file.read_bytes())
        path = self._folder / f"{self.run.name}-{digest.hexdigest()[:10]}-{name}.csv"
        if not path.exists():
            _write_table(path, compute())
        return read_table(path)


def grid(maze: Maze) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " rows"]]:
    """Return x and y of the points of the value map (m)."""
    low, high = maze.arena.low, maze.arena.high
    x, y = (np.linspace(a, b, round((b - a) / SPACING) + 1) for a, b in zip(low, high, strict=True))
    return x, y


def _episode_table(recordings: list[Recording], maze: Maze) -> Table:
    starts = np.array([r.achieved[0][POSITION] for r in recordings], np.float64)
    goals = np.array([r.goal[POSITION] for r in recordings], np.float64)
    # Observations are rounded to float32: a point at the allowed distance from a wall stays free.
    radius = ROBOT_RADIUS - 1e-3
    distances = [geodesic_distance(maze, s, g, radius) for s, g in zip(starts, goals, strict=True)]
    return {
        "episode": np.arange(len(recordings)),
        "task": np.array([r.task for r in recordings]),
        "start_x": starts[:, 0],
        "start_y": starts[:, 1],
        "goal_x": goals[:, 0],
        "goal_y": goals[:, 1],
        "geodesic": np.array(distances),
        "success": np.array([int(r.success) for r in recordings]),
        "length": np.array([r.length for r in recordings]),
        "final_distance": np.array([r.final_distance for r in recordings]),
        "flipped": np.array([int(_is_flipped(r)) for r in recordings]),
    }


def _is_flipped(recording: Recording) -> bool:
    """Return whether the torso's up axis points down; the point has none."""
    last = recording.observations[-1]
    return len(last) > max(COSINES) and float(np.prod(last[list(COSINES)])) < 0


def _path_table(recordings: list[Recording]) -> Table:
    paths = [_thinned(r.achieved[:, POSITION].astype(np.float64)) for r in recordings]
    episode = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
    x, y = np.concatenate(paths).T
    return {"episode": episode, "x": x, "y": y}


def _thinned(path: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "P 2"]:
    """Return the path with its ends and at most ``PATH_POINTS`` positions."""
    kept = np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).round().astype(int)
    return np.asarray(path[kept])


def _write_table(path: Path, table: Table) -> None:
    """Write a CSV file that is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".new")
    columns: list[list[Any]] = [
        [f"{value:.6g}" if isinstance(value, float) else value for value in column.tolist()]
        for column in table.values()
    ]
    with temporary.open("w", newline="") as file:
        csv.writer(file).writerows([list(table), *zip(*columns, strict=True)])
    temporary.replace(path)
