"""Learning curves: success over environment steps and over training time."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from midway.reports import style
from midway.reports.runs import Group, Table
from midway.reports.statistics import Curve, Run, curve

Column: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

TASKS = {"hard": "hard task", "uniform": "uniform tasks"}
LINES = {"mean": "-", "sampled": (0, (2, 1.5))}
"""Solid lines for mean actions, dashed ones for sampled actions."""

NAME_LINES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)))
"""Lines of several distances of one run."""

DISTANCE = "final_distance_"
"""How the columns of distances with names begin."""

MARKS = 10
"""Marks on a long curve, about."""

TIME_POINTS = 100
"""Points at which runs of different speeds are compared over time."""


def draw(groups: Sequence[Group]) -> Figure:
    """Draw success on both tasks (columns) over steps and over minutes (rows)."""
    figure, axes = style.figure(2, 2, height=6.2, sharey=True)
    for row, clock in enumerate(("step", "minutes")):
        for column, (task, title) in enumerate(TASKS.items()):
            panel = axes[2 * row + column]
            for group in groups:
                for actions in LINES:
                    _draw_group(panel, group, task, actions, clock)
            x = "environment steps" if clock == "step" else "training time (minutes)"
            style.label(panel, f"Success, {title}" if row == 0 else "", x)
            style.success_axis(panel)
            panel.set_xlim(left=0)
            if clock == "step":
                panel.xaxis.set_major_formatter(thousands)
    style.legend_below(figure, _legend(groups))
    return figure


def draw_overview(environments: Mapping[str, Sequence[Group]]) -> Figure:
    """Draw success of mean actions over steps: tasks in rows, environments in columns.

    The last column is all environments together, for labels that every environment has.
    """
    together = {task: list(_together(environments, task)) for task in TASKS}
    columns = len(environments) + any(together.values())
    figure, axes = style.figure(len(TASKS), columns, height=5.2, sharey=True)
    for row, (task, title) in enumerate(TASKS.items()):
        panels = axes[row * columns : (row + 1) * columns]
        for panel, (env, groups) in zip(panels, environments.items(), strict=False):
            for group in groups:
                _draw_group(panel, group, task, "mean", "step")
            style.label(panel, env if row == 0 else "", "steps", f"success, {title}")
        for group, drawn in together[task]:
            _draw_curve(panels[-1], group, "mean", drawn)
            style.label(panels[-1], "all together" if row == 0 else "", "steps")
    for panel in axes:
        style.success_axis(panel)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_locator(MaxNLocator(4))
        panel.xaxis.set_major_formatter(thousands)
        panel.label_outer()
    groups_of_labels = {g.label: g for groups in environments.values() for g in groups}
    style.legend_below(figure, _group_entries(list(groups_of_labels.values())))
    return figure


def _together(
    environments: Mapping[str, Sequence[Group]], task: str
) -> Iterator[tuple[Group, Curve]]:
    """Yield the curve over all environments of every label that all of them have."""
    for first in next(iter(environments.values())):
        same = [g for groups in environments.values() for g in groups if g.label == first.label]
        strata = [_series(group, task, "mean", "step") for group in same]
        if len(same) == len(environments) and all(strata):
            steps = np.unique(np.concatenate([x for runs in strata for x, _ in runs]))
            yield first, curve(strata, steps)


def thousands(value: float | int, position: object = None) -> str:
    """Return a number of steps in short: 8k, 1.5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def success_curve(group: Group, task: str, actions: str, clock: str) -> Curve | None:
    """Return success along ``step`` or ``minutes``; None before the first evaluation.

    Over minutes seeds differ in speed: the curve begins when all have been evaluated, and a seed
    that is done keeps its last success.
    """
    return _curve(_series(group, task, actions, clock), clock)


def distances(group: Group) -> list[str]:
    """Return names of distances that evaluations of the group tell apart, such as ``hand``."""
    columns = dict.fromkeys(name for run in group.runs for name in run.evaluation)
    return [name.removeprefix(DISTANCE) for name in columns if name.startswith(DISTANCE)]


def draw_distances(groups: Sequence[Group], threshold: float) -> Figure:
    """Draw each named distance to the goal at the end of episodes, over steps, by task."""
    names = list(dict.fromkeys(name for group in groups for name in distances(group)))
    figure, axes = style.figure(1, len(TASKS), height=3.6, sharey=True)
    for panel, (task, title) in zip(axes, TASKS.items(), strict=True):
        for group in groups:
            for name, line in zip(names, NAME_LINES, strict=False):
                series = _series(group, task, "mean", "step", DISTANCE + name)
                if (drawn := _curve(series, "step")) is not None:
                    _draw_curve(panel, group, "mean", drawn, line)
        panel.axhline(threshold, color=style.MUTED, linestyle=":", linewidth=1.4)
        style.label(panel, f"Distance at the end, {title}", "environment steps", "m")
        panel.set_ylim(bottom=0)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_formatter(thousands)
    lines = [
        Line2D([], [], color=style.MUTED, linewidth=2, linestyle=line, label=name)
        for name, line in zip(names, NAME_LINES, strict=False)
    ]
    near = Line2D([], [], color=style.MUTED, linestyle=":", label="near enough")
    style.legend_below(figure, [*_group_entries(groups), *lines, near])
    return figure


def _curve(series: list[Run], clock: str) -> Curve | None:
    """Return the curve of several runs; None if there are none."""
    if not series:
        return None
    places = np.unique(np.concatenate([x for x, _ in series]))
    if clock != "step" and len(series) > 1:
        places = np.linspace(max(x[0] for x, _ in series), places[-1], TIME_POINTS)
    return curve([series], places)


def _series(
    group: Group, task: str, actions: str, clock: str, column: str = "success_rate"
) -> list[Run]:
    """Return success, or another column, of every run that has been evaluated."""
    tables = [(run, run.evaluated(task, actions)) for run in group.runs]
    series = [
        (run, _clock(table, clock), table[column])
        for run, table in tables
        if column in table and len(table["step"])
    ]
    last = max((x[-1] for _, x, _ in series), default=0.0)
    return [
        _kept(x, y, last) if run.finished and clock != "step" else (x, y) for run, x, y in series
    ]


def _kept(x: Column, y: Column, last: float) -> Run:
    """Return a run that keeps its last success until ``last``."""
    return np.append(x, max(last, x[-1])), np.append(y, y[-1])


def _clock(table: Table, clock: str) -> Column:
    return table["step"] if clock == "step" else table["training_seconds"] / 60


def _draw_group(axes: Axes, group: Group, task: str, actions: str, clock: str) -> None:
    drawn = success_curve(group, task, actions, clock)
    if drawn is not None:
        _draw_curve(axes, group, actions, drawn)


def _draw_curve(axes: Axes, group: Group, actions: str, drawn: Curve, line: Any = None) -> None:
    """Draw the line; for mean actions also marks, and the interval of several runs."""
    axes.plot(
        drawn.x,
        drawn.centre,
        color=group.colour,
        linestyle=line or LINES[actions],
        linewidth=2,
        marker=group.marker if actions == "mean" else None,
        markersize=4,
        markevery=max(1, len(drawn.x) // MARKS),
    )
    if actions == "mean" and len(drawn.x) and drawn.runs.max() > 1:
        band = drawn.interval
        axes.fill_between(drawn.x, band.low, band.high, color=group.colour, alpha=0.18, lw=0)


def _legend(groups: Sequence[Group]) -> list[Line2D]:
    kinds = [
        Line2D([], [], color=style.MUTED, linewidth=2, linestyle=line, label=f"{actions} actions")
        for actions, line in LINES.items()
    ]
    return _group_entries(groups) + kinds


def _group_entries(groups: Sequence[Group]) -> list[Line2D]:
    return [
        Line2D(
            [],
            [],
            color=group.colour,
            linewidth=2,
            marker=group.marker,
            markersize=5,
            label=f"{group.label} ({seeds(group)})",
        )
        for group in groups
    ]


def seeds(group: Group) -> str:
    """Return how many runs there are, in words."""
    return "1 seed" if len(group.runs) == 1 else f"{len(group.runs)} seeds"
