"""Learning curves: success over environment steps and over training time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.reports import style
from midway.reports.runs import Group, Table
from midway.reports.statistics import Curve, curve

TASKS = {"hard": "hard task", "uniform": "uniform tasks"}
LINES = {"mean": "-", "sampled": (0, (2, 1.5))}
"""Solid lines for mean actions, dashed ones for sampled actions."""

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


def thousands(value: float, position: float = 0) -> str:
    """Return a number of steps in short: 8k, 1.5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def success_curve(group: Group, task: str, actions: str, clock: str) -> Curve | None:
    """Return success along ``step`` or ``minutes``; None before the first evaluation."""
    tables = [run.evaluated(task, actions) for run in group.runs]
    series = [(_clock(t, clock), t["success_rate"]) for t in tables if t and len(t["step"])]
    if not series:
        return None
    places = np.unique(np.concatenate([x for x, _ in series]))
    if clock != "step" and len(series) > 1:
        places = np.linspace(places[0], places[-1], TIME_POINTS)
    return curve(series, places)


def _clock(table: Table, clock: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return table["step"] if clock == "step" else table["training_seconds"] / 60


def _draw_group(axes: Axes, group: Group, task: str, actions: str, clock: str) -> None:
    drawn = success_curve(group, task, actions, clock)
    if drawn is None:
        return
    dense = len(drawn.x) > 30
    axes.plot(
        drawn.x,
        drawn.centre,
        color=group.colour,
        linestyle=LINES[actions],
        linewidth=2,
        marker=group.marker if actions == "mean" else None,
        markersize=4,
        markevery=max(1, len(drawn.x) // 10) if dense else 1,
    )
    if drawn.runs.max() > 1 and actions == "mean":
        band = drawn.interval
        axes.fill_between(drawn.x, band.low, band.high, color=group.colour, alpha=0.18, lw=0)


def _legend(groups: Sequence[Group]) -> list[Line2D]:
    names = [
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
    kinds = [
        Line2D([], [], color=style.MUTED, linewidth=2, linestyle=line, label=f"{actions} actions")
        for actions, line in LINES.items()
    ]
    return names + kinds


def seeds(group: Group) -> str:
    """Return how many runs there are, in words."""
    return "1 seed" if len(group.runs) == 1 else f"{len(group.runs)} seeds"
