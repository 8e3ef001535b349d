"""What run folders hold, read for figures."""

import csv
import dataclasses
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from midway.reports import style
from midway.training.folder import RunConfig, RunFolder, read_json
from midway.types import ConfigurationError

Table: TypeAlias = dict[str, np.ndarray[Any, np.dtype[Any]]]
"""Columns by name: float64, or text for the columns of ``TEXT_COLUMNS``."""

Row: TypeAlias = dict[str, float]
"""One row of numbers by column."""

WATCHING = ("steps", "evaluate_every", "evaluation_episodes", "log_every", "checkpoint_every")
"""Settings that a run does not learn from."""

TEXT_COLUMNS = ("task", "actions")


@dataclass(frozen=True)
class RunData:
    """One run folder.

    Attributes:
        folder: Names of its files.
        config: What was run.
        record: All of ``config.json``: versions, commit, machine and command too.
        metrics: Scalars of training; no columns before the first row.
        evaluation: Evaluations; no columns before the first row.
    """

    folder: RunFolder
    config: RunConfig
    record: dict[str, Any]
    metrics: Table
    evaluation: Table

    @property
    def steps(self) -> int:
        """The last environment step that the files tell of."""
        tables = (self.metrics, self.evaluation)
        return max((int(table["step"].max()) for table in tables if table), default=0)

    @property
    def finished(self) -> bool:
        """Whether all configured steps were taken."""
        return self.steps >= self.config.train.steps

    @property
    def has_policy(self) -> bool:
        """Whether a policy was saved."""
        return self.folder.policy_weights.exists() and self.folder.policy_config.exists()

    @property
    def policy_step(self) -> int:
        """The step that the policy was saved at, or that of the newest checkpoint."""
        with suppress(ConfigurationError):  # whoever loads the policy says what is wrong
            step = read_json(self.folder.policy_config).get("step")
            if isinstance(step, int):
                return step
        folder = self.folder.checkpoints
        names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
        return max((int(name) for name in names if name.isdigit()), default=self.steps)

    @property
    def past_weights(self) -> dict[int, Path]:
        """Weights that were kept before the policy was saved, by step."""
        files = self.folder.past_policies.glob("step-*.safetensors")
        steps = {int(file.stem.removeprefix("step-")): file for file in files}
        return {step: steps[step] for step in sorted(steps) if step < self.policy_step}

    @property
    def name(self) -> str:
        """The run in file names and lists."""
        return f"{self.config.env}-{self.config.agent}-seed{self.config.seed}"

    def evaluated(self, task: str, actions: str) -> Table:
        """Return the evaluations of one task with one kind of action."""
        if not self.evaluation:
            return {}
        chosen = (self.evaluation["task"] == task) & (self.evaluation["actions"] == actions)
        return {name: column[chosen] for name, column in self.evaluation.items()}


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed, and in nothing else that they learn from.

    Attributes:
        slug: Name in file names, such as ``ris``, or ``ris-2`` for other settings.
        label: Name in legends, such as ``RIS``.
        colour: Its colour in every figure.
        marker: Its mark in every figure.
        runs: The runs, by seed.
    """

    slug: str
    label: str
    colour: str
    marker: str
    runs: tuple[RunData, ...]

    @property
    def agent(self) -> str:
        """Name of the agent."""
        return self.runs[0].config.agent


def read(path: Path) -> RunData:
    """Return what is in a run folder.

    Raises:
        ConfigurationError: It is no run folder, or damaged, or of another version.
    """
    folder = RunFolder(path)
    config = folder.load_config()
    record = read_json(folder.config_file)
    return RunData(
        folder,
        config,
        record,
        read_table(folder.metrics_file),
        read_table(folder.evaluation_file),
    )


def read_table(path: Path) -> Table:
    """Return the columns of a CSV file; none if it is not there or has no rows.

    A last line that is being written while we read is left out.

    Raises:
        ConfigurationError: The file holds something else.
    """
    if not path.exists():
        return {}
    try:
        with path.open(newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
        whole = [row for row in rows if len(row) == len(header)]
        columns = dict(zip(header, zip(*whole, strict=True), strict=False))
        return {
            name: np.array(values) if name in TEXT_COLUMNS else _numbers(values)
            for name, values in columns.items()
        }
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error


def _numbers(values: Sequence[str]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return numbers; NaN where a row has none."""
    return np.array([value or "nan" for value in values], np.float64)


def row(table: Table, place: int) -> Row:
    """Return one row of a table of numbers; -1 is the last."""
    return {name: float(column[place]) for name, column in table.items()}


def groups(runs: Sequence[RunData]) -> list[Group]:
    """Return runs of one environment, grouped by all that they learn from but the seed."""
    by_settings: dict[str, list[RunData]] = {}
    for run in runs:
        by_settings.setdefault(repr(_settings(run.config)), []).append(run)
    gathered = sorted(by_settings.values(), key=lambda group: _order(group[0].config.agent))
    colours = iter(style.SPARE_COLOURS * len(gathered))
    counts: Counter[str] = Counter()
    found: list[Group] = []
    for number, members in enumerate(gathered):
        agent = members[0].config.agent
        rivals = [other[0].config for other in gathered if other[0].config.agent == agent]
        counts[agent] += 1
        first = counts[agent] == 1
        colour = style.AGENT_COLOURS.get(agent) if first else None
        found.append(
            Group(
                slug=agent if first else f"{agent}-{counts[agent]}",
                label=", ".join([agent.upper(), *_differences(members[0].config, rivals)]),
                colour=colour or next(colours),
                marker=style.MARKERS[number % len(style.MARKERS)],
                runs=tuple(sorted(members, key=lambda run: run.config.seed)),
            )
        )
    return found


def _order(agent: str) -> int:
    """Return the place of an agent in legends."""
    known = list(style.AGENT_COLOURS)
    return known.index(agent) if agent in known else len(known)


def _settings(config: RunConfig) -> dict[str, Any]:
    """Return all values that runs of one group share."""
    train = dataclasses.asdict(config.train)
    train = {name: value for name, value in train.items() if name not in WATCHING}
    values = {**train, **dataclasses.asdict(config.hyperparameters)}
    return {"agent": config.agent, "preset": config.preset, **values}


def _differences(config: RunConfig, rivals: Sequence[RunConfig]) -> list[str]:
    """Return the settings of this group that differ from another group of the same agent."""
    mine = _settings(config)
    others = [_settings(rival) for rival in rivals]
    return [f"{name} {mine[name]}" for name in mine if any(o[name] != mine[name] for o in others)]
