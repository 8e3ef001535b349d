"""A gallery of failures: episodes that did not reach their goal, and how they ended."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.envs.geodesic import way_left
from midway.envs.mazes import Maze
from midway.envs.views import MazeView, TableView
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import Cache, Episode, Study
from midway.reports.recordings import Recording
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture
from midway.types import DistanceTask, GoalTask

SHOWN = 4
"""Failed episodes on the page, at most."""

NEAR = 1.0
"""Way left (m) of an episode that ended near its goal."""

STILL = 0.5
"""What a robot moves (m) in the last fifth of an episode, less than which is standing still."""


SHARE = 0.25
"""Share of the distance at the start, less than which is near the goal elsewhere than in mazes."""

CALM = 0.05
"""Share of it that the distance changes by in the last fifth, less than which is standing still."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield the failures of each group: of the policy of its first usable seed."""
    for group in runs.groups:
        for study in cache.studies(group)[:1]:
            if isinstance(runs.view, MazeView):
                ways = [episode for episode in study.episodes() if not episode.success]
                if ways:
                    yield _maps(runs, group, study, ways)
            elif failed := [each for each in study.recordings if not each.success]:
                yield _curves(runs, group, study, failed)


def _maps(runs: Runs, group: Group, study: Study, failed: Sequence[Episode]) -> Picture:
    shown = chosen(failed)
    return Picture(
        f"{runs.slug}-{group.slug}-failures",
        lambda: draw(study.maze, shown),
        f"Failures of {group.label}",
        f"{len(shown)} of the {_counted(study, failed, len(study.episodes()))}; the cross is where "
        "an episode ended.",
        f"Maps of {runs.env} with the ways of failed episodes of {group.label}.",
        conclusion(study.maze, failed),
    )


def _curves(runs: Runs, group: Group, study: Study, failed: Sequence[Recording]) -> Picture:
    task, limit = study.policy.spec.task, study.policy.spec.max_episode_steps
    unit = " (m)" if isinstance(runs.view, TableView) else ""
    return Picture(
        f"{runs.slug}-{group.slug}-failures",
        lambda: draw_distances(task, study.recordings, unit),
        f"Failures of {group.label}",
        f"Distance to the goal along the {_counted(study, failed, len(study.recordings))}, and, "
        "pale, along those that did; the cross is where an episode ended.",
        f"Distance to the goal in {runs.env} over the steps of failed episodes of {group.label}.",
        conclusion_of_distances(task, failed, limit),
    )


def _counted(study: Study, failed: Sequence[Episode | Recording], total: int) -> str:
    """Return how many episodes failed of those that were recorded, and of which tasks."""
    tasks = {task: sum(e.task == task for e in failed) for task in {e.task: 0 for e in failed}}
    listed = ", ".join(f"{count} of {task}" for task, count in tasks.items())
    return (
        f"{len(failed)} recorded episodes of {total} that did not reach their goal "
        f"({study.where}; {listed})"
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
    return _listed(counts)


def _listed(counts: Mapping[str, Bool[np.ndarray, " failed"]]) -> str:
    """Return how often each word is true, in words."""
    total = len(next(iter(counts.values())))
    parts = [f"{int(mask.sum())} {words}" for words, mask in counts.items() if mask.any()]
    return f"Of {total} failures, {'; '.join(parts)}."


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


# --- elsewhere than in mazes ----------------------------------------------------------------------


def conclusion_of_distances(task: GoalTask, failed: Sequence[Recording], limit: int) -> str:
    """Return how failed episodes ended, in words; ``limit`` is the steps of a whole one."""
    ways = [np.asarray(task.distance(each.states, each.target)) for each in failed]
    first, last = (np.array([way[place] for way in ways]) for place in (0, -1))
    moved = np.array([np.ptp(way[-max(2, len(way) // 5) :]) for way in ways])
    cut = np.array([each.length < limit for each in failed])
    near, farther, still = last < SHARE * first, last > first, moved < CALM * first
    return _listed(
        {
            "were ended by the environment": cut,
            f"ended with less than {style.percent(SHARE)} of the distance left": ~cut & near,
            "ended no nearer than they began": ~cut & farther,
            "stood still on the way": ~cut & ~near & ~farther & still,
            "were still on their way, or went to and fro": ~cut & ~near & ~farther & ~still,
        }
    )


def draw_distances(task: GoalTask, recordings: Sequence[Recording], unit: str) -> Figure:
    """Draw the distance over time of every episode, a panel for each part of the goal."""
    ways = [_distances(task, each) for each in recordings]
    names = list(ways[0])
    width = style.WIDTH if len(names) > 1 else 0.62 * style.WIDTH
    figure, axes = style.figure(1, len(names), height=3.6, width=width)
    for panel, name in zip(axes, names, strict=True):
        for recording, way in zip(recordings, ways, strict=True):
            _draw_way(panel, way[name], recording.success)
        if isinstance(task, DistanceTask):
            panel.axhline(task.threshold, color=maps.GOAL, linewidth=1.3)
        panel.set_ylim(bottom=0)
        style.label(panel, name, "step of the episode", f"distance to the goal{unit}")
    style.legend_below(figure, _entries(task))
    return figure


def _distances(task: GoalTask, recording: Recording) -> dict[str, Float[np.ndarray, " T"]]:
    """Return the distance of each part of the goal in every state, by its name."""
    pair = recording.states, recording.target
    named = task.named_distances(*pair) if isinstance(task, DistanceTask) else {}
    return {name: np.asarray(way) for name, way in (named or {"": task.distance(*pair)}).items()}


def _draw_way(axes: Axes, way: Float[np.ndarray, " T"], success: bool) -> None:
    if success:
        axes.plot(way, color=maps.REACHED, linewidth=1, alpha=0.3)
        return
    axes.plot(way, color=maps.FAILED, linestyle=maps.DASHES, linewidth=1.3, alpha=0.8)
    axes.plot(len(way) - 1, way[-1], "X", color=maps.FAILED, markersize=8, clip_on=False, zorder=7)


def _entries(task: GoalTask) -> list[Line2D]:
    look: style.Look = {"color": maps.FAILED, "linestyle": maps.DASHES, "marker": "X"}
    entries = [
        Line2D([], [], markersize=8, label="failed, and where it ended", **look),
        Line2D([], [], color=maps.REACHED, linewidth=1, alpha=0.3, label="reached the goal"),
    ]
    if isinstance(task, DistanceTask):
        entries.append(Line2D([], [], color=maps.GOAL, label="below this line is reached"))
    return entries
