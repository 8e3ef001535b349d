"""Imagined subgoals during training, the subgoal chain, and the value of a goal."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.envs.mazes import Maze
from midway.reports import maps, style
from midway.reports.curves import thousands
from midway.reports.runs import Row, Table, row
from midway.reports.study import Study, grid

HEAT = LinearSegmentedColormap.from_list(
    "heat", [(0.90, 0.62, 0.0, 0.0), (0.90, 0.62, 0.0, 0.75), (0.84, 0.37, 0.0, 0.95)]
)
"""From nothing over orange to vermilion."""

DIAMOND: dict[str, Any] = {
    "marker": "D",
    "color": maps.SUBGOAL,
    "markeredgecolor": style.INK,
    "zorder": 5,
}
"""The mark of a mean imagined subgoal."""

HEAT_POINTS = 200
"""Points along each side of a heat map."""


def draw_subgoals(study: Study, label: str) -> Figure:
    """Draw where subgoals of the hard task are imagined at moments of training, and the chain."""
    table = study.subgoals()
    moments = [row(table, place) for place in range(len(table["step"]))]
    figure, axes = maps.panels(study.maze, len(moments) + 1)
    for panel, moment in zip(axes, moments, strict=False):
        _draw_heat(panel, study.maze, moment)
        style.caption(panel, label, f"step {thousands(moment['step'])}")
    _draw_chain(axes[-1], moments[-1], study.chain())
    style.caption(axes[-1], "subgoal chain", f"step {thousands(moments[-1]['step'])}")
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
) -> Any:
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
    maze = next(iter(studies.values())).maze
    figure, axes = maps.panels(maze, len(studies), side=1.2)
    x, y = grid(maze)
    image: Any = None
    for panel, (label, study) in zip(axes, studies.items(), strict=True):
        shades = tables[label]["value"].reshape(len(y), len(x))
        colours = {"cmap": "viridis", "vmin": lowest, "vmax": 0, "zorder": 1}
        image = show_image(panel, maze, shades, x, y, **colours)
        case = maze.cases["hard"]
        start, goal = (np.array([box.x, box.y]) for box in (case.start, case.goal))
        maps.draw_ends(panel, start, goal)
        style.caption(panel, label, f"step {thousands(study.run.policy_step)}")
    bar = figure.colorbar(image, ax=axes, shrink=0.8, fraction=0.06)
    bar.set_label(unit, fontsize=style.TEXT, color=style.INK)
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.outline.set_visible(False)
    style.legend_below(figure, maps.ends_legend())
    return figure
