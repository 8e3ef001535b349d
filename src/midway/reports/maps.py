"""Mazes from above, with what a policy does and imagines in them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle as Patch
from matplotlib.ticker import MultipleLocator

from midway.envs.mazes import MAZES, Maze
from midway.reports import imagination, style
from midway.reports.rollouts import Recording
from midway.training.policy import Policy

MARGIN = 0.5
"""How much of the outer walls is drawn (m)."""

TICK = 3.0
"""Distance between numbers on both axes (m)."""

PANEL_HEIGHT = 6.0
"""Largest height of a map (inches)."""

WALL, FLOOR = "#b9bec5", "#ffffff"
START, GOAL, SUBGOAL = style.BLACK, style.GREEN, style.ORANGE

SAMPLES = 300
"""Imagined subgoals that are drawn for one start and goal."""


def maze_of(env: str) -> Maze | None:
    """Return the maze of an environment such as ``ant-u``; None if it has none."""
    return MAZES.get(env.partition("-")[2])


def draw_maze(axes: Axes, maze: Maze) -> None:
    """Draw floor and walls from their geometry, in metres, x to the right and y up."""
    axes.grid(visible=False)
    axes.set_facecolor(FLOOR)
    for wall in maze.walls:
        size = (2 * wall.half_x, 2 * wall.half_y)
        axes.add_patch(Patch(wall.low, *size, facecolor=WALL, edgecolor=WALL, lw=0.5, zorder=1))
    seen = maze.arena.grown(MARGIN)
    axes.set_xlim(seen.low[0], seen.high[0])
    axes.set_ylim(seen.low[1], seen.high[1])
    axes.set_aspect("equal")
    axes.spines[:].set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(TICK))
    style.label(axes, x="x (m)", y="y (m)")


def panels(maze: Maze, columns: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with maps of the maze side by side."""
    ratio = maze.arena.half_y / maze.arena.half_x
    height = min(style.WIDTH / columns * ratio, PANEL_HEIGHT)
    width = min(style.WIDTH, columns * (height / ratio + 0.9))
    figure, axes = style.figure(1, columns, height=height + 1.1, width=width)
    for each in axes:
        draw_maze(each, maze)
    return figure, axes


def draw(maze: Maze, title: str, policy: Policy, recordings: Sequence[Recording]) -> Figure:
    """Draw trajectories on the hard task and on uniform tasks, with the imagined subgoals."""
    figure, (hard, uniform) = panels(maze, 2)
    chosen = {task: [r for r in recordings if r.task == task] for task in ("hard", "uniform")}
    for axes, task in ((hard, "hard"), (uniform, "uniform")):
        reached = sum(recording.success for recording in chosen[task])
        axes.set_title(
            f"{title}, {task}\n{reached} of {len(chosen[task])} episodes reach the goal",
            fontsize=style.TEXT,
            color=style.INK,
        )
        for recording in chosen[task]:
            draw_path(axes, recording)
    if imagination.imagines(policy):
        first = chosen["hard"][0]
        pair = (first.observations[:1], first.goal[None])
        scatter_subgoals(hard, imagination.subgoals(policy, *pair, SAMPLES)[0, :, :2])
    style.legend_below(figure, _legend(imagination.imagines(policy)))
    return figure


def draw_path(axes: Axes, recording: Recording) -> None:
    """Draw one episode: start, goal and the way between them."""
    path, goal = recording.achieved[:, :2], recording.goal[:2]
    colour = style.BLUE if recording.success else style.VERMILION
    line = "-" if recording.success else (0, (3, 1.5))
    axes.plot(*path.T, color=colour, linestyle=line, linewidth=1.3, alpha=0.8, zorder=3)
    axes.plot(*path[0], "o", color=START, markersize=6, markeredgecolor="white", zorder=5)
    axes.plot(*goal, "*", color=GOAL, markersize=11, markeredgecolor="white", zorder=5)


def scatter_subgoals(axes: Axes, positions: Float[np.ndarray, "n 2"]) -> None:
    """Draw imagined subgoals as a cloud of points; those beyond the picture are cut off."""
    axes.plot(
        *positions.T, "D", color=SUBGOAL, markersize=4, markeredgecolor="none", alpha=0.45, zorder=4
    )


def _legend(subgoals: bool) -> list[Line2D]:
    entries = [
        Line2D([], [], color=style.BLUE, label="reached the goal"),
        Line2D([], [], color=style.VERMILION, linestyle=(0, (3, 1.5)), label="did not"),
        Line2D([], [], color=START, marker="o", linestyle="", label="start"),
        Line2D([], [], color=GOAL, marker="*", markersize=11, linestyle="", label="goal"),
    ]
    if subgoals:
        entries.append(
            Line2D([], [], color=SUBGOAL, marker="D", linestyle="", label="imagined subgoals")
        )
    return entries
