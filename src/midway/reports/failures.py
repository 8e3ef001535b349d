"""A gallery of failures: episodes in a maze that did not reach their goal, and how they ended."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.envs.geodesic import way_left
from midway.envs.mazes import Maze
from midway.envs.views import MazeView
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import Cache, Episode, Study
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture

SHOWN = 4
"""Failed episodes on the page, at most."""

NEAR = 1.0
"""Way left (m) of an episode that ended near its goal."""

STILL = 0.5
"""What a robot moves (m) in the last fifth of an episode, less than which is standing still."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield the failures of each group: of the policy of its first usable seed."""
    if isinstance(runs.view, MazeView):
        for group in runs.groups:
            for study in cache.studies(group)[:1]:
                failed = [episode for episode in study.episodes() if not episode.success]
                if failed:
                    yield _picture(runs, group, study, failed)


def _picture(runs: Runs, group: Group, study: Study, failed: Sequence[Episode]) -> Picture:
    total = len(study.episodes())
    tasks = {task: sum(e.task == task for e in failed) for task in {e.task: 0 for e in failed}}
    listed = ", ".join(f"{count} of {task}" for task, count in tasks.items())
    shown = chosen(failed)
    return Picture(
        f"{runs.slug}-{group.slug}-failures",
        lambda: draw(study.maze, shown),
        f"Failures of {group.label}",
        f"{len(shown)} of the {len(failed)} recorded episodes of {total} that did not reach their "
        f"goal ({study.where}; {listed}); the cross is where an episode ended.",
        f"Maps of {runs.env} with the ways of failed episodes of {group.label}.",
        conclusion(study.maze, failed),
    )


def chosen(failed: Sequence[Episode]) -> list[Episode]:
    """Return some failed episodes, of as many tasks as there are."""
    tasks = list(dict.fromkeys(episode.task for episode in failed))
    of_task = [[episode for episode in failed if episode.task == task] for task in tasks]
    turns = range(max(map(len, of_task)))
    return [group[turn] for turn in turns for group in of_task if turn < len(group)][:SHOWN]


def conclusion(maze: Maze, failed: Sequence[Episode]) -> str:
    """Return how failed episodes ended, in words."""
    left = np.array([_left(maze, episode) for episode in failed])
    still = np.array([_stands_still(episode) for episode in failed])
    flipped = np.array([episode.flipped for episode in failed])
    counts = {
        "lay on their backs": flipped,
        f"ended less than {NEAR:.0f} m before the goal": ~flipped & (left < NEAR),
        "stood still at the end": ~flipped & (left >= NEAR) & still,
        "were still on their way, or went to and fro": ~flipped & (left >= NEAR) & ~still,
    }
    parts = [f"{int(mask.sum())} {words}" for words, mask in counts.items() if mask.any()]
    return f"Of {len(failed)} failures, {'; '.join(parts)}."


def draw(maze: Maze, shown: Sequence[Episode]) -> Figure:
    """Draw a map for each episode."""
    figure, axes = maps.panels(maze, len(shown))
    for panel, episode in zip(axes, shown, strict=True):
        maps.draw_path(panel, episode)
        panel.plot(*episode.path[-1], "X", color=maps.FAILED, markersize=9, zorder=7)
        style.caption(panel, episode.task, f"{_left(maze, episode):.1f} m left")
    look: style.Look = {"color": maps.FAILED, "linestyle": ""}
    end = Line2D([], [], marker="X", markersize=9, label="end of the episode", **look)
    style.legend_below(figure, [*maps.ends_legend(), end])
    return figure


def _left(maze: Maze, episode: Episode) -> float:
    return float(way_left(maze, episode.path[-1:], episode.goal)[0])


def _stands_still(episode: Episode) -> bool:
    last = episode.path[-max(2, len(episode.path) // 5) :]
    return float(np.linalg.norm(last - last[-1], axis=-1).max()) < STILL
