"""Success against difficulty: the length of the shortest path, and the numbered cases."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.envs.views import MazeView
from midway.reports import style
from midway.reports.cache import Cache, Episode
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture
from midway.statistics import Estimate, of_agent
from midway.training.evaluate import ActionKind

BINS = 6
"""Bins of geodesic distance."""

TASKS = ("uniform", "hard")

KINDS: dict[ActionKind, str] = {"mean": "deterministic", "sampled": "with sampled actions"}

Seeds: TypeAlias = list[list[Episode]]
"""Episodes of each seed; starts and goals are the same for every seed."""

Results: TypeAlias = Mapping[str, tuple[Group, Seeds]]
"""Groups and the episodes of their seeds, by label."""


def figures(runs: Runs, cache: Cache, kinds: Sequence[ActionKind] = ("mean",)) -> Iterator[Picture]:
    """Yield one figure of all groups with policies, in a maze; a row for each kind of action."""
    if not isinstance(runs.view, MazeView):
        return
    found = [(group, studies) for group in runs.groups if (studies := cache.studies(group))]
    if not found:
        return
    rows: dict[ActionKind, Results] = {
        kind: {
            group.label: (group, [s.episodes(kind) for s in studies]) for group, studies in found
        }
        for kind in kinds
    }
    cases = [name for name in runs.view.maze.cases if name.startswith("case-")]
    words = " and ".join(KINDS[kind] for kind in kinds)
    yield Picture(
        f"{runs.slug}-difficulty",
        lambda: draw(rows, cases),
        "Success against difficulty",
        f"The saved policies, {words}, with the same starts and goals for all. Each bin of "
        "uniform tasks holds as many episodes. Bars: 95 % intervals, which count seeds and "
        "episodes (bootstrap), or the episodes of a single seed (Wilson).",
        f"Success on {runs.env} by length of the shortest path"
        + (" and by numbered case." if cases else "."),
        "Success that falls to the right: the policy reaches what is near, and does not find long "
        "ways. Success that is low everywhere: it does not move well.",
    )


def draw(rows: Mapping[ActionKind, Results], cases: Sequence[str]) -> Figure:
    """Draw success over the geodesic distance, and over the numbered cases where there are any.

    Args:
        rows: What each kind of action reached.
        cases: Names of the numbered cases of the maze, by difficulty.
    """
    columns = 2 if cases else 1
    width = style.WIDTH if cases else 0.62 * style.WIDTH
    height = 0.5 + 3.4 * len(rows)
    figure, axes = style.figure(len(rows), columns, height=height, width=width, sharey=True)
    for row, (kind, results) in enumerate(rows.items()):
        panels = axes[row * columns : (row + 1) * columns]
        _draw_bins(panels[0], results)
        if cases:
            _draw_cases(panels[1], results, cases)
        for panel in panels:
            style.success_axis(panel)
        if len(rows) > 1:
            panels[0].set_ylabel(f"success, {KINDS[kind]}", fontsize=style.TEXT)
    style.legend_below(figure, [_entry(group, seeds) for group, seeds in results.values()])
    return figure


def bins(episodes: Sequence[Episode]) -> Int[np.ndarray, " episodes"]:
    """Return the bin of each episode, by the length of its shortest path; all hold as many."""
    rank = np.argsort(np.argsort([episode.geodesic for episode in episodes], kind="stable"))
    return np.asarray(rank * BINS // len(episodes))


def summary(successes: Sequence[Bool[np.ndarray, " episodes"]]) -> Estimate:
    """Return the success of seeds on the same episodes, with its interval."""
    return of_agent([float(seed.mean()) for seed in successes], [len(seed) for seed in successes])


def _draw_bins(axes: Axes, results: Results) -> None:
    """Draw uniform tasks by distance, and the hard task as a hollow mark."""
    for place, (group, seeds) in enumerate(results.values()):
        uniform, hard = ([[e for e in s if e.task == task] for s in seeds] for task in TASKS)
        members = bins(uniform[0])
        aside = 2.5 * _aside(place, len(results))
        points = []
        for number in range(BINS):
            chosen = [[e for e, b in zip(s, members, strict=True) if b == number] for s in uniform]
            if chosen[0]:
                points.append((_distance(chosen) + aside, *summary(_successes(chosen))))
        _draw_points(axes, group, points)
        _draw_points(axes, group, [(_distance(hard) + aside, *summary(_successes(hard)))], "white")
    axes.set_xlim(left=0)
    style.label(axes, "Uniform tasks, and hard (hollow)", "shortest path from start to goal (m)")


def _distance(seeds: Seeds) -> float:
    """Return the mean length of the shortest paths (m), the same for all seeds."""
    return float(np.mean([episode.geodesic for episode in seeds[0]]))


def _draw_cases(axes: Axes, results: Results, cases: Sequence[str]) -> None:
    metres = []
    for place, (group, seeds) in enumerate(results.values()):
        points = []
        for number, case in enumerate(cases):
            chosen = [[e for e in seed if e.task == case] for seed in seeds]
            middle = number + _aside(place, len(results))
            points.append((middle, *summary(_successes(chosen))))
            metres.append(_distance(chosen))
        _draw_points(axes, group, points)
    names = [case.removeprefix("case-") for case in cases]
    ticks = [f"{name}\n{distance:.0f} m" for name, distance in zip(names, metres, strict=False)]
    axes.set_xticks(range(len(cases)), ticks)
    style.label(axes, "Numbered cases of the paper", "case, and its mean shortest path")


def _successes(seeds: Seeds) -> list[Bool[np.ndarray, " episodes"]]:
    return [np.array([episode.success for episode in seed], np.bool_) for seed in seeds]


def _aside(place: int, groups: int) -> float:
    """Return how far a group's points stand from the middle, so that intervals do not overlap."""
    return 0.12 * (place - (groups - 1) / 2)


def _draw_points(
    axes: Axes,
    group: Group,
    points: Sequence[tuple[float, float, float, float]],
    fill: str | None = None,
) -> None:
    """Draw points (x, centre, low, high) with their intervals; ``fill`` is the marks' inside."""
    x, centre, low, high = np.array(points).T
    look: style.Look = {"color": group.colour, "marker": group.marker, "linewidth": 1.8}
    errors = np.maximum([centre - low, high - centre], 0)
    look |= {"markersize": 6, "markerfacecolor": fill or group.colour, "elinewidth": 1}
    axes.errorbar(x, centre, errors, **look, capsize=3)


def _entry(group: Group, seeds: Seeds) -> Line2D:
    count = "1 seed" if len(seeds) == 1 else f"{len(seeds)} seeds"
    return Line2D(
        [],
        [],
        color=group.colour,
        marker=group.marker,
        linewidth=2,
        label=f"{group.label} ({count})",
    )
