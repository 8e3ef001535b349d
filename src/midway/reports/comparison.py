"""Agents against each other at the end of their runs: in figures, and in one line."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.errors import ConfigurationError
from midway.reports import style
from midway.reports.cache import Cache
from midway.reports.curves import SUCCESS, TASKS
from midway.reports.runs import Group, RunData, Runs, groups, read, seeds_of
from midway.reports.style import Picture
from midway.statistics import Estimate, Scores, improvement, of_runs, performance_profile

THRESHOLDS = np.linspace(0, 1, 201)
"""Success rates at which profiles are drawn."""

LIMITS = (-0.04, 1.04)
"""Of the axes of shares, with room for marks at both ends."""

LETTERS = 20
"""Letters in a line of a pair's name."""


@dataclass(frozen=True)
class Side:
    """The runs of one group in one or several environments, at their last evaluation of a task.

    Attributes:
        group: The group, in the first of the environments.
        strata: Success of its runs in each environment.
    """

    group: Group
    strata: tuple[Scores, ...]

    @property
    def success(self) -> Estimate:
        """Interquartile mean of its runs, with its interval."""
        centre, interval = of_runs(self.strata)
        return Estimate(*(float(each[0]) for each in (centre, *interval)))

    def over(self, other: "Side") -> Estimate:
        """Return the probability that one of its runs is better than one of the other's."""
        pairs = zip(self.strata, other.strata, strict=True)
        return improvement([(ours.values[:, 0], theirs.values[:, 0]) for ours, theirs in pairs])


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield the comparison of the groups of an environment, where there are several."""
    yield from _pictures(runs.slug, [runs])


def overview(environments: Sequence[Runs]) -> Iterator[Picture]:
    """Yield the comparison of the agents that several environments share."""
    if len(environments) > 1:
        yield from _pictures("all", environments)


def _pictures(slug: str, environments: Sequence[Runs]) -> Iterator[Picture]:
    found = {task: sides(environments, task) for task in TASKS}
    compared = {task: each for task, each in found.items() if len(each) > 1}
    if not compared:
        return
    said = [
        f"{a.group.label} over {b.group.label} on {TASKS[task]} {a.over(b):.0%}"
        for task, each in compared.items()
        for a, b in combinations(each, 2)
    ]
    yield Picture(
        f"{slug}-comparison",
        lambda: draw(compared),
        "Who is better",
        "The deterministic policy at the last evaluation of each run. Left: interquartile mean. "
        "Middle: the share of runs with more success than a threshold; higher is better. Right: "
        "the probability that a run of the first is better than one of the second; where the "
        "interval holds 50 %, nobody can tell. Intervals of 95 % count seeds and episodes; few "
        "seeds say little of seeds that were not run.",
        "Probability of improvement: " + "; ".join(said) + ".",
        "; ".join(said) + ". One side is better only where the interval leaves out 50 %.",
    )


def sides(environments: Sequence[Runs], task: str, actions: str = "mean") -> list[Side]:
    """Return the groups that all environments share and have evaluated on a task."""
    found = []
    for first in environments[0].groups:
        same = [g for runs in environments for g in runs.groups if g.label == first.label]
        strata = [last_scores(group.runs, task, actions) for group in same]
        if len(same) == len(environments) and all(len(scores.values) for scores in strata):
            found.append(Side(first, tuple(strata)))
    return found


def last_scores(runs: Sequence[RunData], task: str, actions: str) -> Scores:
    """Return success ``(runs, 1)`` at the last evaluation of each run that has one."""
    tables = [table for run in runs if len((table := run.evaluated(task, actions)).get("step", ()))]
    values, episodes = (
        np.array([[table[column][-1]] for table in tables], np.float64).reshape(-1, 1)
        for column in (SUCCESS, "episodes")
    )
    return Scores(values, episodes)


# --- drawing --------------------------------------------------------------------------------------


def draw(compared: dict[str, list[Side]]) -> Figure:
    """Draw interquartile mean, performance profile and probability of improvement by task."""
    rows = max(len(each) for each in compared.values())
    pairs = rows * (rows - 1) // 2
    height = 0.9 + len(compared) * (1.5 + 0.25 * max(rows, pairs))
    figure, axes = style.figure(len(compared), 3, height=height)
    for row, (task, each) in enumerate(compared.items()):
        means, profiles, probabilities = axes[3 * row : 3 * row + 3]
        _draw_means(means, each, TASKS[task])
        _draw_profiles(profiles, each)
        _draw_probabilities(probabilities, each)
    named = {side.group.label: side.group for each in compared.values() for side in each}
    style.legend_below(figure, [_entry(group) for group in named.values()])
    return figure


def _draw_means(axes: Axes, each: Sequence[Side], title: str) -> None:
    for place, side in enumerate(each):
        _draw_estimate(axes, place, side.success, side.group.colour, side.group.marker)
    _share_axis(axes.xaxis)
    axes.set_xlim(*LIMITS)
    axes.set_yticks([])
    _room(axes, len(each))
    style.label(axes, f"Success, {title}", "interquartile mean")


def _draw_profiles(axes: Axes, each: Sequence[Side]) -> None:
    for side in each:
        share, band = performance_profile(side.strata, THRESHOLDS)
        axes.step(THRESHOLDS, share, where="post", color=side.group.colour, linewidth=2)
        axes.fill_between(
            THRESHOLDS, *band, step="post", color=side.group.colour, alpha=0.18, linewidth=0
        )
    _share_axis(axes.xaxis)
    _share_axis(axes.yaxis)
    axes.set_xlim(*LIMITS)
    style.label(axes, "Runs with more success", "success")


def _draw_probabilities(axes: Axes, each: Sequence[Side]) -> None:
    pairs = list(combinations(each, 2))
    for place, (a, b) in enumerate(pairs):
        _draw_estimate(axes, place, a.over(b), style.INK, "o")
    names = [textwrap.fill(f"{a.group.label} over {b.group.label}", LETTERS) for a, b in pairs]
    axes.axvline(0.5, color=style.MUTED, linestyle=":", linewidth=1.4)
    axes.set_yticks(range(len(pairs)), names)
    _share_axis(axes.xaxis)
    axes.set_xlim(*LIMITS)
    _room(axes, len(pairs))
    style.label(axes, "Who is better", "probability of improvement")


def _draw_estimate(axes: Axes, place: int, found: Estimate, colour: str, marker: str) -> None:
    errors = [[found.centre - found.low], [found.high - found.centre]]
    look: style.Look = {"color": colour, "marker": marker, "capsize": 3, "elinewidth": 1.6}
    axes.errorbar([found.centre], [place], xerr=np.maximum(errors, 0), **look)


def _share_axis(axis: XAxis | YAxis) -> None:
    axis.set_ticks([0, 0.5, 1], ["0 %", "50 %", "100 %"])


def _room(axes: Axes, rows: int) -> None:
    """Let rows run from the top down."""
    axes.set_ylim(rows - 0.4, -0.6)


def _entry(group: Group) -> Line2D:
    label = f"{group.label} ({seeds_of([group])})"
    return Line2D([], [], color=group.colour, marker=group.marker, linewidth=2, label=label)


# --- in words -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """Whether the runs of one side are better than those of another.

    Attributes:
        env: Environment name.
        task: The task that both were evaluated on.
        actions: ``mean`` or ``sampled``.
        names: What the sides are called.
        success: Success of each side, interquartile mean over its runs.
        seeds: Runs of each side.
        steps: The fewest steps of a run of each side at its last evaluation.
        probability: That a run of the first is better than one of the second.
    """

    env: str
    task: str
    actions: str
    names: tuple[str, str]
    success: tuple[Estimate, Estimate]
    seeds: tuple[int, int]
    steps: tuple[int, int]
    probability: Estimate

    @property
    def verdict(self) -> str:
        """Who is better, if the interval of the probability does not hold one half."""
        first, second = self.names
        if self.probability.low > 0.5:
            return f"{first} is better than {second}"
        if self.probability.high < 0.5:
            return f"{second} is better than {first}"
        return f"nobody can tell whether {first} or {second} is better"

    def __str__(self) -> str:
        """Return all of it in one line."""
        sides = [
            f"{name} {success:.0%} of {seeds} seed{'s' * (seeds > 1)} at {steps:,} steps"
            for name, success, seeds, steps in zip(
                self.names, self.success, self.seeds, self.steps, strict=True
            )
        ]
        return (
            f"{self.env}, {self.task}, {self.actions} actions: {self.verdict}: "
            f"probability of improvement {self.probability:.0%}; {', '.join(sides)}"
        )


def compare(
    paths: Sequence[Path],
    against: Sequence[Path] = (),
    task: str | None = None,
    actions: str = "mean",
) -> Comparison:
    """Return whether the runs of one side are better than those of the other.

    Args:
        paths: Run folders, or folders with the CSV files and ``config.json`` of runs.
        against: Those of the other side; none where ``paths`` are two groups of settings.
        task: The task; default: ``hard``, if it was evaluated, else ``uniform``.
        actions: ``mean`` or ``sampled``.

    Raises:
        ConfigurationError: Environments differ, the sides are not two, or a run is not evaluated.
    """
    first, second = ([read(path) for path in side] for side in (paths, against))
    names = sorted({run.config.env for run in (*first, *second)})
    if len(names) != 1:
        what = ", ".join(names) or "none given"
        raise ConfigurationError(f"only runs in one environment can be compared: {what}")
    gathered = groups([*first, *second])
    ours, theirs = (first, second) if second else _two(gathered)
    shared = {run.folder.path.resolve() for run in ours} & {r.folder.path.resolve() for r in theirs}
    if shared:
        raise ConfigurationError(f"{min(shared)} is on both sides")
    chosen = task or next(
        (name for name in TASKS if any(run.evaluated(name, actions) for run in ours)), "hard"
    )
    for run in (*ours, *theirs):
        if not len(run.evaluated(chosen, actions).get("step", ())):
            why = "; ".join(run.damaged) or "none yet"
            raise ConfigurationError(
                f"{run.folder.path}: no evaluation of {chosen} with {actions} actions: {why}"
            )
    a, b = (Side(gathered[0], (last_scores(side, chosen, actions),)) for side in (ours, theirs))
    return Comparison(
        names[0],
        chosen,
        actions,
        _names(gathered, ours, theirs),
        (a.success, b.success),
        (len(ours), len(theirs)),
        (_steps(ours, chosen, actions), _steps(theirs, chosen, actions)),
        a.over(b),
    )


def _two(gathered: Sequence[Group]) -> tuple[list[RunData], list[RunData]]:
    """Return the runs of two groups.

    Raises:
        ConfigurationError: There are not two.
    """
    if len(gathered) != 2:
        labels = "; ".join(group.label for group in gathered)
        raise ConfigurationError(
            f"two sides are compared, and here are {len(gathered)} ({labels}): name the second "
            "after --against"
        )
    first, second = gathered
    return list(first.runs), list(second.runs)


def _names(
    gathered: Sequence[Group], ours: Sequence[RunData], theirs: Sequence[RunData]
) -> tuple[str, str]:
    """Return what the sides are called: by their groups, where these are not the same."""
    first, second = (
        " and ".join(g.label for g in gathered if {id(run) for run in g.runs} & side)
        for side in ({id(run) for run in ours}, {id(run) for run in theirs})
    )
    return (first, second) if first != second else (f"the first {first}", f"the second {second}")


def _steps(runs: Sequence[RunData], task: str, actions: str) -> int:
    return int(min(run.evaluated(task, actions)["step"][-1] for run in runs))
