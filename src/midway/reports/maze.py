"""Mazes from above, with what a policy does in them."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle as Patch
from matplotlib.ticker import MultipleLocator

from midway.envs.mazes import Maze
from midway.envs.views import MazeView
from midway.reports import style
from midway.reports.cache import Cache, Episode, Study
from midway.reports.runs import Group, Runs, row
from midway.reports.style import Picture

MARGIN = 0.9
"""How much of the outer walls is drawn (m)."""

TICK = 3.0
"""Distance between numbers on both axes (m)."""

PANEL_HEIGHT = 5.5
"""Largest height of a map (inches)."""

WALL, FLOOR = "#b9bec5", "#ffffff"
START, GOAL, SUBGOAL = style.BLACK, style.GREEN, style.ORANGE
REACHED, FAILED = style.BLUE, style.VERMILION
DASHES = (0, (3, 1.5))

SAMPLES = 300
"""Imagined subgoals that are drawn for one start and goal."""

SHOWN = {"hard": 8, "uniform": 12}
"""Episodes on a map."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield a map of each group: the policy of its first usable seed."""
    if isinstance(runs.view, MazeView):
        for group in runs.groups:
            for study in cache.studies(group)[:1]:
                yield _picture(runs, group, study)


def _picture(runs: Runs, group: Group, study: Study) -> Picture:
    return Picture(
        f"{runs.slug}-{group.slug}-map",
        lambda: draw(study, group.label),
        f"{group.label} in the maze",
        f"Ways of the deterministic policy ({study.where}). Walls are grey; an episode ends within "
        "0.5 m of its goal."
        + (" The subgoals are drawn by the subgoal policy at a start." if study.imagines else "")
        + (" The plan is that of an episode from the middle of the start." if study.plans else "")
        + _flips(runs, study),
        f"Map of {runs.env} with the ways of {group.label}; success over all recorded episodes: "
        + ", ".join(f"{task} {_rate(study, task)}" for task in SHOWN)
        + ".",
        "Of all recorded episodes the policy reaches "
        + ", ".join(f"{_rate(study, task)} of {task}" for task in SHOWN)
        + ". Ways that bend around walls show that it knows the maze; ways that end at a wall "
        "on the straight line to the goal, that it does not.",
    )


def _rate(study: Study, task: str) -> str:
    reached = [episode.success for episode in study.episodes() if episode.task == task]
    return style.percent(sum(reached) / len(reached))


def _flips(runs: Runs, study: Study) -> str:
    """Return how often an ant lies on its back at the end."""
    if not isinstance(runs.view, MazeView) or runs.view.upright is None:
        return ""
    flipped = [episode.flipped for episode in study.episodes()]
    return (
        f" The ant ends on its back in {style.percent(sum(flipped) / len(flipped))} of "
        f"{len(flipped)} recorded episodes."
    )


def panels(maze: Maze, columns: int, side: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure with maps of the maze side by side, and room (inches) for a colour bar."""
    ratio = maze.arena.half_y / maze.arena.half_x
    height = min((style.WIDTH - side - 0.9) / columns * ratio, PANEL_HEIGHT)
    width = min(style.WIDTH, columns * (height / ratio + 0.4) + side + 0.5)
    figure, axes = style.figure(1, columns, height=height + 1.8, width=width, sharey=True)
    for each in axes:
        draw_maze(each, maze)
    for each in axes[1:]:
        each.set_ylabel("")
        each.tick_params(left=False)
    return figure, axes


def draw_maze(axes: Axes, maze: Maze) -> None:
    """Draw floor and walls from their geometry, in metres, x to the right and y up."""
    axes.grid(visible=False)
    axes.set_facecolor(FLOOR)
    for wall in maze.walls:
        size = (2 * wall.half_x, 2 * wall.half_y)
        axes.add_patch(Patch(wall.low, *size, facecolor=WALL, edgecolor=WALL, lw=0.5, zorder=2))
    seen = maze.arena.grown(MARGIN)
    axes.set_xlim(seen.low[0], seen.high[0])
    axes.set_ylim(seen.low[1], seen.high[1])
    axes.set_aspect("equal")
    axes.spines[:].set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(TICK))
    style.label(axes, x="x (m)", y="y (m)")


def draw(study: Study, label: str) -> Figure:
    """Draw trajectories on the hard task and on uniform tasks, with the imagined subgoals."""
    figure, axes = panels(study.maze, 2)
    for panel, (task, count) in zip(axes, SHOWN.items(), strict=True):
        shown = [episode for episode in study.episodes() if episode.task == task][:count]
        reached = sum(episode.success for episode in shown)
        style.caption(panel, f"{label}, {task}", f"{reached} of {len(shown)} reach the goal")
        for episode in shown:
            draw_path(panel, episode)
    if study.imagines:
        scatter_subgoals(axes[0], sample(study))
    if study.plans:
        plan, (start, goal) = study.plan(), study.ends()
        positions = np.stack([plan["x"], plan["y"]], axis=1)
        draw_plan(axes[0], np.stack([start, *positions, goal]))
    imagined = "imagined" if study.imagines else "planned" if study.plans else ""
    style.legend_below(figure, _legend(imagined))
    return figure


def sample(study: Study) -> Float[np.ndarray, "n 2"]:
    """Return positions of subgoals that are imagined for the hard task (m)."""
    last = row(study.subgoals(), -1)
    centre, scale = (last["x"], last["y"]), (last["scale_x"], last["scale_y"])
    return np.asarray(np.random.default_rng(0).laplace(centre, scale, (SAMPLES, 2)))


def draw_path(axes: Axes, episode: Episode) -> None:
    """Draw one episode: start, goal and the way between them."""
    colour, line = (REACHED, "-") if episode.success else (FAILED, DASHES)
    axes.plot(*episode.path.T, color=colour, linestyle=line, linewidth=1.3, alpha=0.8, zorder=3)
    draw_ends(axes, episode.path[0], episode.goal)


def draw_ends(
    axes: Axes, start: Float[np.ndarray, "2"], goal: Float[np.ndarray, "2"], size: float = 1.0
) -> None:
    """Draw a start and a goal (m), with marks of a size relative to those of figures."""
    outline: style.Look = {"markeredgecolor": "white", "zorder": 6, "linestyle": ""}
    axes.plot(*start, marker="o", color=START, markersize=6 * size, **outline)
    axes.plot(*goal, marker="*", color=GOAL, markersize=12 * size, **outline)


def scatter_subgoals(axes: Axes, positions: Float[np.ndarray, "n 2"]) -> None:
    """Draw imagined subgoals as a cloud of points; those beyond the picture are cut off."""
    axes.plot(
        *positions.T, "D", color=SUBGOAL, markersize=4, markeredgecolor="none", alpha=0.45, zorder=4
    )


def draw_plan(axes: Axes, way: Float[np.ndarray, "N 2"]) -> None:
    """Draw planned subgoals in their order, on a line from the start to the goal (m)."""
    axes.plot(*way.T, color=SUBGOAL, linewidth=1.5, zorder=5)
    look: style.Look = {"color": SUBGOAL, "markersize": 7, "markeredgecolor": style.INK}
    axes.plot(*way[1:-1].T, "D", zorder=6, **look)
    draw_ends(axes, way[0], way[-1])


def ends_legend() -> list[Line2D]:
    """Return the entries of start and goal."""
    return [
        Line2D([], [], color=START, marker="o", linestyle="", label="start"),
        Line2D([], [], color=GOAL, marker="*", markersize=11, linestyle="", label="goal"),
    ]


def _legend(subgoals: str) -> list[Line2D]:
    """Return the entries; ``subgoals`` are imagined, planned, or none."""
    entries = [
        Line2D([], [], color=REACHED, label="reaches the goal"),
        Line2D([], [], color=FAILED, linestyle=DASHES, label="does not"),
        *ends_legend(),
    ]
    if subgoals:
        name = f"subgoals {subgoals} at the start"
        entries.append(Line2D([], [], color=SUBGOAL, marker="D", linestyle="", label=name))
    return entries
