"""What run folders hold, read for figures."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from midway import tables
from midway.agent import AnyAgent
from midway.agents import registry as agents
from midway.envs import registry as environments
from midway.envs.views import View
from midway.errors import ConfigurationError
from midway.reports import style
from midway.runs import kept
from midway.runs import policy as policies
from midway.runs.folder import RunConfig, RunFolder, read_json, run_name
from midway.runs.kept import Best, Which
from midway.tables import Table
from midway.training.arrays import checked_arrays
from midway.types import JsonObject

Row: TypeAlias = dict[str, float]
"""One row of numbers by column."""

WATCHING = ("steps", "evaluate_every", "evaluation_episodes", "log_every", "checkpoint_every")
"""Settings that a run does not learn from."""


METRICS = ("step", "updates", "seconds")
EVALUATION = (*METRICS, "task", "actions", "success_rate", "final_distance")
"""Columns without which a file cannot be of a run."""
NAMED_SETTINGS = 3
"""Settings that tell groups of an agent apart in legends, at most."""


@dataclass(frozen=True)
class RunData:
    """One run folder.

    Attributes:
        folder: Names of its files.
        config: What was run.
        record: All of ``config.json``: versions, commit, machine and command too.
        metrics: Scalars of training; no columns before the first row.
        evaluation: Evaluations; no columns before the first row.
        damaged: What cannot be read, in words; it is treated as if it were not there.
        which: The policy that is looked at.
        changes: Settings that it acts with, in place of those it was trained with.
    """

    folder: RunFolder
    config: RunConfig
    record: JsonObject
    metrics: Table
    evaluation: Table
    damaged: tuple[str, ...] = ()
    which: Which = "last"
    changes: Mapping[str, object] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """The last environment step that the files tell of."""
        tables = (self.metrics, self.evaluation)
        return max((int(table["step"].max()) for table in tables if table), default=0)

    @property
    def finished(self) -> bool:
        """Whether all configured steps were taken, or those until it was ended early."""
        ended = self.folder.ended_at()
        return self.steps >= (self.config.train.steps if ended is None else ended)

    @property
    def has_policy(self) -> bool:
        """Whether a policy was saved."""
        return self.folder.policy_weights.exists() and self.folder.policy_config.exists()

    @property
    def weights(self) -> Path:
        """The weights of the policy.

        Raises:
            ConfigurationError: They were not kept.
        """
        return kept.weights_of(self.folder, self.which)

    @property
    def best(self) -> Best | None:
        """How good the best policy is, if one was kept."""
        return kept.best(self.folder)

    @property
    def policy_step(self) -> int:
        """The step that the policy was saved at, or that of the newest checkpoint."""
        if isinstance(self.which, int):
            return self.which
        if self.which == "best" and self.best is not None:
            return self.best.step
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
        found = kept.snapshots(self.folder)
        steps = {step: file for step, file in found.items() if not _damage(file)}
        return {step: steps[step] for step in sorted(steps) if step < self.policy_step}

    @property
    def name(self) -> str:
        """The run in file names."""
        return style.file_name(run_name(self.config.env, self.config.agent, self.config.seed))

    @property
    def agent(self) -> AnyAgent:
        """The agent, which says what it is able to."""
        return agents.get(self.config.agent)

    @property
    def acting(self) -> JsonObject:
        """What a trained policy may be given other values of, as it acts here."""
        trained = self.config.hyperparameters
        return {n: getattr(trained, n) for n in self.agent.test_settings} | dict(self.changes)

    @property
    def view(self) -> View | None:
        """How the environment is drawn; None if nobody knows."""
        with suppress(ConfigurationError):  # its package may be missing here
            return self.config.declaration().view
        return None

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


def seeds_of(groups: Sequence[Group]) -> str:
    """Return how many runs each group has, in words: of the smallest to the largest."""
    counts = sorted({len(group.runs) for group in groups})
    numbers = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    return f"{numbers} seed{'s' * (counts[-1] > 1)}"


@dataclass(frozen=True)
class Runs:
    """Runs in one environment.

    Attributes:
        env: Name of the environment.
        groups: The runs, in groups.
    """

    env: str
    groups: Sequence[Group]

    @property
    def slug(self) -> str:
        """The environment in file names."""
        return style.file_name(self.env)

    @property
    def view(self) -> View | None:
        """How the environment is drawn; None if nobody knows."""
        return self.groups[0].runs[0].view


def read(
    path: Path, policy: Which = "last", changes: Mapping[str, object] | None = None
) -> RunData:
    """Return what is in a run folder.

    Args:
        path: The run folder.
        policy: The policy that is looked at.
        changes: Settings that it acts with, as in `Policy.using`.

    Raises:
        ConfigurationError: It is no run folder, its configuration is damaged or of another version,
            or a setting may not change after training.
    """
    folder = RunFolder.at(path)
    config = folder.load_config()
    changed = policies.acting_settings(config, changes or {}).hyperparameters
    changes = {name: getattr(changed, name) for name in changes or {}}
    record = read_json(folder.config_file)
    metrics, wrong = _table(folder.metrics_file, METRICS)
    evaluation, wrong_too = _table(folder.evaluation_file, EVALUATION)
    weights = [_damage(file) for file in kept.snapshots(folder).values()]
    damaged = tuple(text for text in (wrong, wrong_too, *weights) if text)
    return RunData(folder, config, record, metrics, evaluation, damaged, policy, changes)


def _table(path: Path, columns: Sequence[str]) -> tuple[Table, str]:
    """Return a table and what is wrong with it; no columns then."""
    try:
        found = tables.read(path)
    except ConfigurationError as error:
        return {}, str(error)
    missing = [name for name in columns if name not in found]
    if found and missing:
        return {}, f"{path} is damaged: it has no columns {', '.join(missing)}"
    return found, ""


def _damage(weights: Path) -> str:
    """Return what is wrong with a file of weights; nothing if it is whole."""
    try:
        checked_arrays(weights)
    except ConfigurationError as error:
        return str(error)
    return ""


def row(table: Table, place: int) -> Row:
    """Return one row of a table of numbers; -1 is the last."""
    return {name: float(column[place]) for name, column in table.items()}


def by_environment(runs: Sequence[RunData]) -> list[Runs]:
    """Return the runs of every environment, in the order of the registry and then by name."""
    known = list(environments.ENVIRONMENTS)
    names = {run.config.env for run in runs}
    ordered = sorted(names, key=lambda name: (name not in known, *_place(known, name), name))
    return [Runs(name, groups([run for run in runs if run.config.env == name])) for name in ordered]


def groups(runs: Sequence[RunData]) -> list[Group]:
    """Return runs of one environment, grouped by all that they learn from but the seed."""
    by_settings: dict[str, list[RunData]] = {}
    for run in runs:
        by_settings.setdefault(repr(_settings(run.config)), []).append(run)
    known = list(style.AGENT_COLOURS)
    gathered = sorted(by_settings.values(), key=lambda group: _place(known, group[0].config.agent))
    agents = [members[0].config.agent for members in gathered]
    names = agent_labels(agents)
    slugs = _slugs([style.file_name(name.lower()) for name in names])
    # Only the first group of an agent has the agent's own colour.
    firsts = [agent not in agents[:place] for place, agent in enumerate(agents)]
    own = [style.AGENT_COLOURS.get(a) if f else None for a, f in zip(agents, firsts, strict=True)]
    colours = style.colours(own)
    return [
        Group(
            slug=slug,
            label=", ".join([name, *_differences(members[0].config, gathered)]),
            colour=colour,
            marker=style.MARKERS[number % len(style.MARKERS)],
            runs=tuple(sorted(members, key=lambda run: str(run.config.seed).zfill(12))),
        )
        for number, (slug, name, colour, members) in enumerate(
            zip(slugs, names, colours, gathered, strict=True)
        )
    ]


def agent_labels(agents: Sequence[str]) -> list[str]:
    """Return the names of agents in legends: ``RIS`` of ``ris``.

    An agent from outside, ``package.module:NAME``, goes by NAME, or by its module where that is
    ``AGENT``; by all of it where two would be called the same.
    """
    short = {agent: _agent_label(agent) for agent in agents}
    counts = Counter(short.values())
    return [short[agent] if counts[short[agent]] == 1 else agent for agent in agents]


def _agent_label(agent: str) -> str:
    module, _, name = agent.partition(":")
    if not name:
        return agent.upper()
    return module.rpartition(".")[2] if name.lower() == "agent" else name


def _slugs(names: Sequence[str]) -> list[str]:
    """Return names for files, numbered from the second of a name on."""
    counts: Counter[str] = Counter()
    found = []
    for name in names:
        counts[name] += 1
        found.append(name if counts[name] == 1 else f"{name}-{counts[name]}")
    return found


def _place(known: Sequence[str], name: str) -> tuple[int, str]:
    """Return what sorts names: those that are known first, in their order."""
    return (known.index(name), "") if name in known else (len(known), name)


def _settings(config: RunConfig) -> JsonObject:
    """Return all values that runs of one group share."""
    train = dataclasses.asdict(config.train)
    train = {name: value for name, value in train.items() if name not in WATCHING}
    values = {**train, **dataclasses.asdict(config.hyperparameters)}
    return {"agent": config.agent, "preset": config.preset, **values}


def _differences(config: RunConfig, gathered: Sequence[Sequence[RunData]]) -> list[str]:
    """Return the settings in which this group stands apart from others of the same agent.

    What most groups have is not named; of many settings the first are.
    """
    mine = _settings(config)
    rivals = [members[0].config for members in gathered]
    groups = [_settings(rival) for rival in rivals if rival.agent == config.agent]
    apart = [
        f"{name} {value}"
        for name, value in mine.items()
        if 2 * sum(group[name] == value for group in groups) <= len(groups)
    ]
    more = len(apart) - NAMED_SETTINGS
    return apart if more <= 0 else [*apart[:NAMED_SETTINGS], f"{more} more settings"]
