"""Learning curves: success and distances over environment steps and over training time."""

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from midway.envs.push import GOAL_THRESHOLD
from midway.envs.views import TableView
from midway.reports import style
from midway.reports.cache import Cache
from midway.reports.runs import Group, Runs, seeds_of
from midway.reports.style import Picture, thousands
from midway.statistics import Curve, Series, curve
from midway.tables import Table

Column: TypeAlias = Float[np.ndarray, " rows"]

TASKS = {"hard": "hard task", "uniform": "uniform tasks"}
LineStyle: TypeAlias = str | tuple[int, tuple[int | float, ...]]
LINES: dict[str, LineStyle] = {"mean": "-", "sampled": (0, (2, 1.5))}
"""Solid lines for the deterministic policy, dashed ones for sampled actions."""

SUCCESS = "success_rate"

STAR = "*"
"""Mark of the best policy."""

NAMES = {"mean": "deterministic policy", "sampled": "sampled actions"}

NAME_LINES: tuple[LineStyle, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)))
"""Lines of several distances of one run."""

DISTANCE = "final_distance_"
"""How the columns of distances with names begin."""

MARKS = 10
"""Marks on a long curve, about."""

TIME_POINTS = 100
"""Points at which runs of different speeds are compared over time."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield success, and the distances that evaluations tell apart."""
    if not any(run.evaluation for group in runs.groups for run in group.runs):
        cache.note("no run has been evaluated: no learning curves")
        return
    yield Picture(
        f"{runs.slug}-learning-curves",
        lambda: draw(runs),
        "Learning curves",
        "Success over environment steps (top) and over the time spent on collection and updates, "
        "without evaluations (bottom). Lines: one seed, or the interquartile mean of several, each "
        "of which has a thin line; shaded: the 95 % interval, which counts episodes and seeds. A "
        "star is the best policy of a seed, at its success on the episodes that confirmed it. Over "
        "time, seeds are compared along straight lines between their evaluations, and a seed that "
        "is done keeps its last success.",
        f"Learning curves on {runs.env}. Last success: "
        + "; ".join(
            f"{group.label} hard {success_text(group, 'hard')}, "
            f"uniform {success_text(group, 'uniform')}"
            for group in runs.groups
        ),
        "The earlier a curve rises and the steadier it stays, the better. Where intervals overlap, "
        "or there is one seed, one curve above another may be luck.",
    )
    names = distances(runs)
    if names:
        yield Picture(
            f"{runs.slug}-distances",
            lambda: draw_distances(runs),
            f"Distance to the goal: {' and '.join(names)}",
            "Mean distance at the end of the evaluations' episodes of the deterministic policy, "
            "each by itself; an episode succeeds where all are below their threshold at once.",
            f"Distance of {' and '.join(names)} to their goals over environment steps, by task.",
            "The distance that stays high is what episodes fail by.",
        )


def overview(environments: Sequence[Runs]) -> Iterator[Picture]:
    """Yield success in all environments, where there are several."""
    if len(environments) > 1:
        yield Picture(
            "all-learning-curves",
            lambda: draw_overview(environments),
            "All environments",
            "Success of the deterministic policy over environment steps, interquartile mean over "
            "seeds with 95 % intervals that count episodes and seeds; all environments together "
            "where they have the same agents.",
            "Learning curves of every environment.",
            "An agent is better where its interval lies above the others' in every environment; "
            "one that leads in some only suits those.",
        )


def draw(runs: Runs) -> Figure:
    """Draw success on both tasks (columns) over steps and over minutes (rows)."""
    figure, axes = style.figure(2, 2, height=6.2, sharey=True)
    for row, clock in enumerate(("step", "minutes")):
        for column, (task, title) in enumerate(TASKS.items()):
            panel = axes[2 * row + column]
            for group in runs.groups:
                for actions in LINES:
                    _draw_group(panel, group, task, actions, clock)
            x = "environment steps" if clock == "step" else "training time (minutes)"
            style.label(panel, f"Success, {title}" if row == 0 else "", x)
            style.success_axis(panel)
            panel.set_xlim(left=0)
            if clock == "step":
                panel.xaxis.set_major_formatter(thousands)
    kinds = [_line(style.MUTED, NAMES[actions], line) for actions, line in LINES.items()]
    if any(run.best for group in runs.groups for run in group.runs):
        kinds.append(_line(style.MUTED, "best policy", "", marker=STAR, markersize=9))
    style.legend_below(figure, _group_entries(runs.groups) + kinds)
    return figure


def draw_overview(environments: Sequence[Runs]) -> Figure:
    """Draw success of the deterministic policy over steps: tasks in rows, environments in columns.

    The last column is all environments together, for labels that every environment has.
    """
    together = {task: list(_together(environments, task)) for task in TASKS}
    columns = len(environments) + any(together.values())
    figure, axes = style.figure(len(TASKS), columns, height=5.2, sharey=True)
    for row, (task, title) in enumerate(TASKS.items()):
        panels = axes[row * columns : (row + 1) * columns]
        for panel, runs in zip(panels, environments, strict=False):
            for group in runs.groups:
                _draw_group(panel, group, task, "mean", "step")
            style.label(panel, runs.env if row == 0 else "", "steps", f"success, {title}")
        for group, drawn in together[task]:
            _draw_curve(panels[-1], group, "mean", drawn)
            style.label(panels[-1], "all together" if row == 0 else "", "steps")
    for panel in axes:
        style.success_axis(panel)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_locator(MaxNLocator(4 if columns < 6 else 3))
        panel.xaxis.set_major_formatter(thousands)
        panel.label_outer()
    style.legend_below(figure, _group_entries([g for runs in environments for g in runs.groups]))
    return figure


def _together(environments: Sequence[Runs], task: str) -> Iterator[tuple[Group, Curve]]:
    """Yield the curve over all environments of every label that all of them have."""
    for first in environments[0].groups:
        same = [g for runs in environments for g in runs.groups if g.label == first.label]
        strata = [series(group, task, "mean", "step") for group in same]
        if len(same) == len(environments) and all(strata):
            steps = np.unique(np.concatenate([run.x for runs in strata for run in runs]))
            yield first, curve(strata, steps)


def success_curve(group: Group, task: str, actions: str, clock: str) -> Curve | None:
    """Return success along ``step`` or ``minutes``; None before the first evaluation.

    Over minutes seeds differ in speed: the curve begins when all have been evaluated, and a seed
    that is done keeps its last success.
    """
    return _curve(series(group, task, actions, clock), clock)


def success_text(group: Group, task: str, actions: str = "mean") -> str:
    """Return the success at the last step that every evaluated run has, with its interval."""
    drawn = success_curve(group, task, actions, "step")
    if drawn is None or not len(drawn.x):
        return "not evaluated"
    last = int((drawn.runs == drawn.runs.max()).nonzero()[0][-1])
    low, high = (style.percent(end[last]) for end in drawn.interval)
    return f"{style.percent(drawn.centre[last])} [{low}, {high}]"


def distances(runs: Runs) -> list[str]:
    """Return names of distances that evaluations tell apart, such as ``hand``."""
    tables = [run.evaluation for group in runs.groups for run in group.runs]
    columns = dict.fromkeys(name for table in tables for name in table)
    return [name.removeprefix(DISTANCE) for name in columns if name.startswith(DISTANCE)]


def draw_distances(runs: Runs) -> Figure:
    """Draw each named distance to the goal at the end of episodes, over steps, by task."""
    lines = dict(zip(distances(runs), NAME_LINES, strict=False))
    entries = [_line(style.MUTED, name, line) for name, line in lines.items()]
    figure, axes = style.figure(1, len(TASKS), height=3.6, sharey=True)
    for panel, (task, title) in zip(axes, TASKS.items(), strict=True):
        for group in runs.groups:
            for name, line in lines.items():
                found = series(group, task, "mean", "step", DISTANCE + name)
                if (drawn := _curve(found, "step")) is not None:
                    _draw_curve(panel, group, "mean", drawn, line)
        style.label(panel, f"Distance at the end, {title}", "environment steps", "m")
        panel.set_ylim(bottom=0)
        panel.set_xlim(left=0)
        panel.xaxis.set_major_formatter(thousands)
    if isinstance(runs.view, TableView):
        look: style.Look = {"color": style.MUTED, "linestyle": ":", "linewidth": 1.4}
        for panel in axes:
            panel.axhline(GOAL_THRESHOLD, **look)
        entries.append(Line2D([], [], label="near enough", **look))
    style.legend_below(figure, [*_group_entries(runs.groups), *entries])
    return figure


def _curve(found: list[Series], clock: str) -> Curve | None:
    """Return the curve of several runs; None if there are none."""
    if not found:
        return None
    places = np.unique(np.concatenate([run.x for run in found]))
    if clock != "step" and len(found) > 1:
        places = np.linspace(max(run.x[0] for run in found), places[-1], TIME_POINTS)
    return curve([found], places)


def series(
    group: Group, task: str, actions: str, clock: str, column: str = SUCCESS
) -> list[Series]:
    """Return success, or another column, of every run that has been evaluated."""
    tables = [(run, run.evaluated(task, actions)) for run in group.runs]
    found = [
        (run, Series(_clock(table, clock), table[column], _counted(table, column)))
        for run, table in tables
        if column in table and len(table["step"])
    ]
    last = max((points.x[-1] for _, points in found), default=0.0)
    return [
        _kept(points, last) if run.finished and clock != "step" else points for run, points in found
    ]


def _counted(table: Table, column: str) -> Column | None:
    """Return the episodes of each success rate; nothing for other columns."""
    return table.get("episodes") if column == SUCCESS else None


def _kept(run: Series, last: float) -> Series:
    """Return a run that keeps its last success until ``last``."""
    episodes = None if run.episodes is None else np.append(run.episodes, run.episodes[-1])
    return Series(np.append(run.x, max(last, run.x[-1])), np.append(run.y, run.y[-1]), episodes)


def _clock(table: Table, clock: str) -> Column:
    return table["step"] if clock == "step" else table["training_seconds"] / 60


def _draw_group(axes: Axes, group: Group, task: str, actions: str, clock: str) -> None:
    drawn = success_curve(group, task, actions, clock)
    if drawn is None:
        return
    _draw_curve(axes, group, actions, drawn)
    if actions == "mean":
        _draw_seeds(axes, group, task, clock)
        _draw_best(axes, group, task, clock)


def _draw_seeds(axes: Axes, group: Group, task: str, clock: str) -> None:
    """Draw a thin line for each of several seeds."""
    found = series(group, task, "mean", clock)
    for run in found if len(found) > 1 else ():
        axes.plot(run.x, run.y, color=group.colour, linewidth=0.7, alpha=0.45, zorder=1.5)


def _draw_best(axes: Axes, group: Group, task: str, clock: str) -> None:
    """Mark the best policy of each seed, where it was evaluated on this task."""
    for run in group.runs:
        table, best = run.evaluated(task, "mean"), run.best
        if best is None or best.task != task or not table:
            continue
        places = _clock(table, clock)[table["step"] == best.step]
        look: style.Look = {"markersize": 11, "markeredgecolor": "white", "zorder": 3}
        axes.plot(places, len(places) * [best.success.centre], STAR, color=group.colour, **look)


def _draw_curve(
    axes: Axes, group: Group, actions: str, drawn: Curve, line: LineStyle | None = None
) -> None:
    """Draw the line; for the deterministic policy also marks, and the interval."""
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
    if actions == "mean":
        band = drawn.interval
        axes.fill_between(drawn.x, band.low, band.high, color=group.colour, alpha=0.18, lw=0)


def _group_entries(groups: Sequence[Group]) -> list[Line2D]:
    """Return an entry for each label, with how many seeds there are of it."""
    of_label: dict[str, list[Group]] = {}
    for group in groups:
        of_label.setdefault(group.label, []).append(group)
    return [
        _line(same[0].colour, f"{label} ({seeds_of(same)})", marker=same[0].marker, markersize=5)
        for label, same in of_label.items()
    ]


def _line(colour: str, label: str, line: LineStyle = "-", **look: Any) -> Line2D:
    """Return an entry of a legend."""
    return Line2D([], [], color=colour, linewidth=2, linestyle=line, label=label, **look)
