"""What saved policies do and imagine, computed once; tables of mazes are kept as CSV files."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from midway import tables
from midway.envs.geodesic import OBSERVED, geodesic_distance
from midway.envs.mazes import Maze
from midway.envs.views import MazeView
from midway.errors import BrokenEnvironmentError, ConfigurationError
from midway.networks.decoder import ImageDecoder
from midway.reports import decoder, recordings
from midway.reports.recordings import Recording, record
from midway.reports.runs import Group, RunData
from midway.runs import policy as policies
from midway.runs.policy import Policy
from midway.tables import Table
from midway.training.evaluate import ActionKind

SEED = 20_210_718
"""Seed of starts and goals in figures: the same for every run, and met in no training."""

VERSION = 4
"""Counted up when the same policy would give other tables."""

STEPS = 30_000
"""About how many steps the episodes on uniform tasks may take together."""

PATH_POINTS = 100
"""Positions that are kept of an episode, at most."""

CHAIN_DEPTH = 3
SNAPSHOTS = 4
"""Snapshots of training that subgoals are shown of, at most."""

SPACING = 0.25
"""Distance between points of the value map (m)."""

ON_TABLE, ELSEWHERE = {"hard": 3, "uniform": 3}, {"uniform": 12}
"""Episodes of each task at the table, and in environments without a view."""


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


class Study:
    """The saved policy of one run: what it does and what it imagines.

    Tables are files, which a second report reads instead; their names hold a digest of the weights
    and of the settings of acting, so another policy has other files.

    Args:
        run: A run with a saved policy.
        folder: Where the tables are kept.
    """

    def __init__(self, run: RunData, folder: Path) -> None:
        self.run = run
        self.agent = run.agent
        self.view = run.view
        self._folder = folder

    @property
    def imagines(self) -> bool:
        """Whether the agent has a policy over subgoals."""
        return self.agent.subgoals is not None

    @property
    def plans(self) -> bool:
        """Whether the agent plans subgoals as it acts."""
        return recordings.plans(self.agent)

    @property
    def value_unit(self) -> str | None:
        """What the agent's values are; None if it has none."""
        return None if self.agent.value is None else self.agent.value.unit

    @property
    def where(self) -> str:
        """The run's seed, the step of its policy and changed settings, for captions."""
        changes = "".join(f", {name} {value}" for name, value in self.run.changes.items())
        return f"seed {self.run.config.seed}, step {self.run.policy_step:,}{changes}"

    @cached_property
    def policy(self) -> Policy:
        """The saved policy.

        Raises:
            ConfigurationError: It is damaged or foreign.
        """
        return self._loaded(self.run.weights)

    @property
    def maze(self) -> Maze:
        """The maze of the environment, which has one."""
        return self._maze_view.maze

    @property
    def _maze_view(self) -> MazeView:
        assert isinstance(self.view, MazeView)
        return self.view

    @cached_property
    def recordings(self) -> list[Recording]:
        """Whole episodes of the deterministic policy: many in a maze, a few elsewhere."""
        return self._recorded("mean")

    @cached_property
    def decoder(self) -> ImageDecoder | None:
        """What draws the policy's features as images, fitted on the side; None without images."""
        seen = decoder.encoder_of(self.policy) is not None
        return decoder.of_policy(self.run.folder, self.policy) if seen else None

    def prepare(self) -> None:
        """Compute what every figure of the policy needs.

        Raises:
            ConfigurationError: The policy is damaged or foreign, or cannot be run here.
        """
        if isinstance(self.view, MazeView):
            self.episodes()
        else:
            assert self.recordings

    def episodes(self, actions: ActionKind = "mean") -> list[Episode]:
        """Return episodes of every task of the policy in its maze, the same for all its actions."""
        suffix = "" if actions == "mean" else f"-{actions}"
        recorded = cache(lambda: self._recorded(actions) if suffix else self.recordings)
        table = self._table(f"episodes{suffix}", lambda: self._episode_table(recorded()))
        paths = self._table(f"paths{suffix}", lambda: self._path_table(recorded()))
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
        """Return location and scale of the subgoals of the hard task, a row for each snapshot."""
        weights = self._snapshots()

        def compute() -> Table:
            start, goal = self._hard_pair()
            position = self._maze_view.position
            rows = []
            for step, file in weights.items():
                found = self._loaded(file).subgoals(start[None], goal[None])
                parts = [part.achieved_goal[0, position] for part in found]
                rows.append([step, *np.ravel([start[position], goal[position], *parts])])
            names = ("step", "start_x", "start_y", "goal_x", "goal_y", "x", "y", "scale_x")
            return dict(zip((*names, "scale_y"), np.array(rows, np.float64).T, strict=True))

        return self._table("subgoals", compute, *weights.values())

    def chain(self) -> Table:
        """Return the positions of the subgoal chain of the hard task."""
        return self._way("chain", partial(recordings.chain, depth=CHAIN_DEPTH))

    def plan(self) -> Table:
        """Return the positions of the subgoals that are planned for the hard task."""
        return self._way("plan", recordings.first_plan)

    def ends(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Return the positions of start and goal in the middle of the hard task's boxes (m)."""
        case = self.maze.cases["hard"]
        return np.array([case.start.x, case.start.y]), np.array([case.goal.x, case.goal.y])

    def values(self) -> Table:
        """Return the value of the goal of the hard task at points all over the arena."""

        def compute() -> Table:
            start, goal = self._hard_pair()
            points = np.stack(np.meshgrid(*grid(self.maze)), axis=-1).reshape(-1, 2)
            observations = np.repeat(start[None], len(points), axis=0)
            observations[:, self._maze_view.position] = points
            goals = np.repeat(goal[None], len(points), axis=0)
            value = self.policy.value(observations, goals)
            return {"x": points[:, 0], "y": points[:, 1], "value": value.astype(np.float64)}

        return self._table("values", compute)

    def _loaded(self, weights: Path) -> Policy:
        return policies.load(self.run.folder, weights).using(self.run.changes)

    def _snapshots(self) -> dict[int, Path]:
        """Return weights by step: some of the past, and the newest."""
        past = self.run.past_weights
        chosen = np.linspace(0, len(past) - 1, min(len(past), SNAPSHOTS - 1)).round().astype(int)
        earlier = {step: past[step] for step in np.array(list(past))[chosen].tolist()}
        return {**earlier, self.run.policy_step: self.run.weights}

    def _recorded(self, actions: ActionKind) -> list[Recording]:
        elsewhere = ELSEWHERE if self.view is None else ON_TABLE
        counts = self._counts() if isinstance(self.view, MazeView) else elsewhere
        return record(self.policy, counts, SEED, actions=actions)

    def _counts(self) -> dict[str, int]:
        """Return the number of episodes of each task: more where they are short."""
        uniform = int(np.clip(STEPS // self.policy.spec.max_episode_steps, 20, 200))
        named = int(np.clip(uniform // 6, 8, 20))
        return {task: uniform if task == "uniform" else named for task in self.maze.cases}

    def _hard_pair(self) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " G"]]:
        """Return state and goal in the middle of the boxes of the hard task."""
        start, goal = self.ends()
        env = self.run.config.declaration().factory()
        options = {"task": "hard", "start": tuple(start.tolist()), "goal": tuple(goal.tolist())}
        observation, _ = env.reset(seed=SEED, options=options)
        return observation["observation"][0], observation["desired_goal"][0]

    def _way(self, name: str, find: Callable[..., Float[np.ndarray, "N G"]]) -> Table:
        """Return the positions of subgoals between start and goal of the hard task."""

        def compute() -> Table:
            way = find(self.policy, *self._hard_pair())[:, self._maze_view.position]
            x, y = way.T.astype(np.float64)
            return {"x": x, "y": y}

        return self._table(name, compute)

    def _table(self, name: str, compute: Callable[[], Table], *weights: Path) -> Table:
        """Return a table from its file, or compute it and write the file."""
        digest = hashlib.sha256(f"{VERSION} {SEED} {self.maze} {self.run.acting}".encode())
        for file in (self.run.weights, *weights):
            digest.update(file.read_bytes())
        path = self._folder / f"{self.run.name}-{digest.hexdigest()[:10]}-{name}.csv"
        if not path.exists():
            tables.write(path, compute())
        return tables.read(path)

    def _episode_table(self, episodes: Sequence[Recording]) -> Table:
        position = self._maze_view.position
        starts = np.array([r.states[0][position] for r in episodes], np.float64)
        goals = np.array([r.target[position] for r in episodes], np.float64)
        pairs = zip(starts, goals, strict=True)
        return {
            "episode": np.arange(len(episodes)),
            "task": np.array([r.task for r in episodes]),
            "start_x": starts[:, 0],
            "start_y": starts[:, 1],
            "goal_x": goals[:, 0],
            "goal_y": goals[:, 1],
            "geodesic": np.array([geodesic_distance(self.maze, s, g, OBSERVED) for s, g in pairs]),
            "success": np.array([int(r.success) for r in episodes]),
            "length": np.array([r.length for r in episodes]),
            "final_distance": np.array([r.final_distance for r in episodes]),
            "flipped": np.array([int(is_flipped(self._maze_view, r)) for r in episodes]),
        }

    def _path_table(self, episodes: Sequence[Recording]) -> Table:
        position = self._maze_view.position
        paths = [_thinned(r.states[:, position].astype(np.float64)) for r in episodes]
        episode = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
        x, y = np.concatenate(paths).T
        return {"episode": episode, "x": x, "y": y}


class Cache:
    """The studies of all runs of a report, and notes of what could not be drawn.

    Args:
        folder: Where tables are kept.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._studies: dict[Path, Study | None] = {}
        self._notes: dict[str, None] = {}

    @property
    def notes(self) -> list[str]:
        """What is missing, and why; each once."""
        return list(self._notes)

    def note(self, text: str) -> None:
        """Add a note."""
        self._notes[text] = None

    def studies(self, group: Group) -> list[Study]:
        """Return the studies of the runs of a group whose policies can be used."""
        found = [self._study(run, group.label) for run in group.runs]
        return [study for study in found if study is not None]

    def _study(self, run: RunData, label: str) -> Study | None:
        key = run.folder.path.resolve()
        if key not in self._studies:
            self._studies[key] = self._prepared(run, f"{label}, seed {run.config.seed}")
        return self._studies[key]

    def _prepared(self, run: RunData, name: str) -> Study | None:
        if not run.has_policy:
            self.note(f"{name}: no policy saved yet, so nothing is drawn of it")
            return None
        study = Study(run, self._folder)
        try:
            study.prepare()
        except (ConfigurationError, BrokenEnvironmentError) as error:
            self.note(f"{name}: the policy cannot be used: {error}")
            return None
        return study


def grid(maze: Maze) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " rows"]]:
    """Return x and y of the points of the value map (m)."""
    low, high = maze.arena.low, maze.arena.high
    x, y = (np.linspace(a, b, round((b - a) / SPACING) + 1) for a, b in zip(low, high, strict=True))
    return x, y


def is_flipped(view: MazeView, recording: Recording) -> bool:
    """Return whether the torso's up axis points down at the end; a point has none."""
    if view.upright is None:
        return False
    return float(np.prod(recording.observations[-1][list(view.upright)])) < 0


def _thinned(path: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "P 2"]:
    """Return the path with its ends and at most ``PATH_POINTS`` positions."""
    kept = np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).round().astype(int)
    return np.asarray(path[kept])
