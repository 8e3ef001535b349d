"""Imagined subgoals during training, the subgoal chain, and the value of a goal."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from midway.envs.mazes import Maze
from midway.envs.views import MazeView
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import Cache, Study, grid
from midway.reports.runs import Group, Row, Runs, row
from midway.reports.style import Picture, thousands
from midway.tables import Table

HEAT = LinearSegmentedColormap.from_list(
    "heat", [(0.90, 0.62, 0.0, 0.0), (0.90, 0.62, 0.0, 0.75), (0.84, 0.37, 0.0, 0.95)]
)
"""From nothing over orange to vermilion."""

DIAMOND: style.Look = {
    "marker": "D",
    "color": maps.SUBGOAL,
    "markeredgecolor": style.INK,
    "zorder": 5,
}
"""The mark of a mean imagined subgoal."""

HEAT_POINTS = 200
"""Points along each side of a heat map."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield the subgoals of each group that imagines any, and the values of each unit."""
    if not isinstance(runs.view, MazeView):
        return
    firsts = [(group, study) for group in runs.groups for study in cache.studies(group)[:1]]
    for group, study in firsts:
        if study.imagines:
            yield _subgoal_picture(runs, cache, group, study)
    for unit in dict.fromkeys(study.value_unit for _, study in firsts):
        if unit is not None:
            alike = [(group, study) for group, study in firsts if study.value_unit == unit]
            yield _value_picture(runs, unit, alike)


def _subgoal_picture(runs: Runs, cache: Cache, group: Group, study: Study) -> Picture:
    count = len(study.subgoals()["step"])
    if count == 1:
        cache.note(
            f"{group.label}, seed {study.run.config.seed}: no past policies were kept, so "
            "imagined subgoals are shown at the last step only"
        )
    return Picture(
        f"{runs.slug}-{group.slug}-subgoals",
        lambda: draw_subgoals(study, group.label),
        f"What {group.label} imagines",
        f"Where the subgoal policy puts subgoals of the hard task ({study.where}), and the chain "
        "that comes from imagining again between start, subgoals and goal: the largest mark is "
        "the first subgoal, smaller ones halve what is left.",
        f"Heat map of imagined subgoals at {count} snapshots of training, and the subgoal chain.",
        "Sound subgoals draw together in the corridor, about half of the way from the goal, and "
        "their chain follows the corridors; a cloud in walls or beside the way helps no policy.",
    )


def _value_picture(runs: Runs, unit: str, studies: Sequence[tuple[Group, Study]]) -> Picture:
    labels = {group.label: study for group, study in studies}
    return Picture(
        f"{runs.slug}-{'-'.join(group.slug for group, _ in studies)}-values",
        lambda: draw_values(labels, unit),
        f"Value of a goal: {', '.join(labels)}",
        "Value of every place for the goal of the hard task, from which the agent starts at rest. "
        "Bright: near by its own reckoning.",
        f"Map of {unit} for {', '.join(labels)} on {runs.env}.",
        "A sound value darkens along the corridors; one that shines through walls takes the "
        "straight line for the way.",
    )


def draw_subgoals(study: Study, label: str) -> Figure:
    """Draw where subgoals of the hard task are imagined at snapshots of training, and the chain."""
    table = study.subgoals()
    snapshots = [row(table, place) for place in range(len(table["step"]))]
    figure, axes = maps.panels(study.maze, len(snapshots) + 1)
    for panel, snapshot in zip(axes, snapshots, strict=False):
        _draw_heat(panel, study.maze, snapshot)
        style.caption(panel, label, f"step {thousands(snapshot['step'])}")
    _draw_chain(axes[-1], snapshots[-1], study.chain())
    style.caption(axes[-1], "subgoal chain", f"step {thousands(snapshots[-1]['step'])}")
    style.legend_below(figure, _legend())
    return figure


def density(
    subgoal: Row, x: Float[np.ndarray, " columns"], y: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows columns"]:
    """Return the density of a Laplace subgoal at points of the plane, as a share of its peak."""
    offset_x = np.abs(x - subgoal["x"]) / subgoal["scale_x"]
    offset_y = np.abs(y - subgoal["y"]) / subgoal["scale_y"]
    return np.asarray(np.exp(-offset_x[None, :] - offset_y[:, None]))


def _draw_heat(axes: Axes, maze: Maze, subgoal: Row) -> None:
    """Draw the root of the density, which shows its tails too."""
    seen = maze.arena.grown(maps.MARGIN)
    x, y = (np.linspace(*ends, HEAT_POINTS) for ends in zip(seen.low, seen.high, strict=True))
    show_image(axes, maze, np.sqrt(density(subgoal, x, y)), x, y, cmap=HEAT, vmin=0, vmax=1)
    axes.plot(subgoal["x"], subgoal["y"], markersize=6, **DIAMOND)
    maps.draw_ends(axes, *_ends(subgoal))


def show_image(
    axes: Axes,
    maze: Maze,
    shades: Float[np.ndarray, "rows columns"],
    x: Float[np.ndarray, " columns"],
    y: Float[np.ndarray, " rows"],
    **options: Any,
) -> AxesImage:
    """Draw numbers at points of the plane as colours and return the image."""
    limits = axes.get_xlim(), axes.get_ylim()
    extent = (x[0], x[-1], y[0], y[-1])
    options = {"zorder": 3, "interpolation": "bilinear", **options}
    image = axes.imshow(shades, origin="lower", extent=extent, **options)
    axes.set(xlim=limits[0], ylim=limits[1])
    return image


def _draw_chain(axes: Axes, subgoal: Row, chain: Table) -> None:
    """Draw the way of the chain; the first subgoal is the largest, its halves are smaller."""
    start, goal = _ends(subgoal)
    way = np.stack([start, *np.stack([chain["x"], chain["y"]], axis=1), goal])
    axes.plot(*way.T, color=style.INK, linewidth=1.2, zorder=4)
    for place in range(1, len(way) - 1):
        axes.plot(*way[place], markersize=5 + 3 * halvings(place), **DIAMOND)
    maps.draw_ends(axes, start, goal)


def halvings(place: int) -> int:
    """Return how often 2 divides the place of a subgoal in its chain."""
    return (place & -place).bit_length() - 1


def _ends(subgoal: Row) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the positions of start and goal (m)."""
    start, goal = ([subgoal[f"{role}_x"], subgoal[f"{role}_y"]] for role in ("start", "goal"))
    return np.array(start), np.array(goal)


def _legend() -> list[Line2D]:
    return [
        *maps.ends_legend(),
        Line2D([], [], linestyle="", markersize=6, label="mean imagined subgoal", **DIAMOND),
        Line2D([], [], color=style.ORANGE, linewidth=7, alpha=0.7, label="where subgoals fall"),
    ]


def draw_values(studies: Mapping[str, Study], unit: str) -> Figure:
    """Draw the value of the hard task's goal from everywhere in the maze, one map per label."""
    tables = {label: study.values() for label, study in studies.items()}
    lowest = min(float(table["value"].min()) for table in tables.values())
    highest = max(float(table["value"].max()) for table in tables.values())
    first = next(iter(studies.values()))
    figure, axes = maps.panels(first.maze, len(studies), side=1.2)
    x, y = grid(first.maze)
    # Values that count down to the goal end at 0.
    colours = {"cmap": "viridis", "vmin": lowest, "vmax": highest if highest > 0 else 0}
    for panel, (label, study) in zip(axes, studies.items(), strict=True):
        shades = tables[label]["value"].reshape(len(y), len(x))
        image = show_image(panel, first.maze, shades, x, y, **colours, zorder=1)
        maps.draw_ends(panel, *first.ends())
        style.caption(panel, label, f"step {thousands(study.run.policy_step)}")
    bar = figure.colorbar(image, ax=axes, shrink=0.8, fraction=0.06)
    bar.set_label(unit, fontsize=style.TEXT, color=style.INK)
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.outline.set_visible(False)
    style.legend_below(figure, maps.ends_legend())
    return figure
