"""From run folders to files: the figures and the page."""

from collections.abc import Sequence
from pathlib import Path

from midway.reports import curves, maps, rollouts, style
from midway.reports.runs import Group, RunData, groups, read
from midway.types import ConfigurationError

MAP_EPISODES = {"hard": 8, "uniform": 12}
"""Episodes of each task on a map."""


def report(paths: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Draw what run folders hold.

    Args:
        paths: Run folders; agents, seeds and environments may differ.
        out: Where the files go; default: ``figures`` in the run's folder, or for several runs
            ``report`` beside the first one.

    Returns:
        The files that were written.

    Raises:
        ConfigurationError: A path is no run folder, or ``out`` cannot be written.
    """
    if not paths:
        raise ConfigurationError("no run folder given")
    folders = {path.resolve(): path for path in paths}
    runs = [read(path) for path in folders.values()]
    if out is None:
        out = runs[0].folder.figures if len(runs) == 1 else paths[0].resolve().parent / "report"
    try:
        out.mkdir(parents=True, exist_ok=True)
        return [file for env in _environments(runs) for file in _draw_environment(env, runs, out)]
    except OSError as error:
        raise ConfigurationError(f"cannot write the report to {out}: {error.strerror}") from error


def _environments(runs: Sequence[RunData]) -> list[str]:
    return list(dict.fromkeys(run.config.env for run in runs))


def _draw_environment(env: str, runs: Sequence[RunData], out: Path) -> list[Path]:
    """Draw everything about one environment."""
    gathered = groups([run for run in runs if run.config.env == env])
    files = style.save(curves.draw(gathered), out / f"{env}-learning-curves")
    for group in gathered:
        files += _draw_map(env, group, out)
    return files


def _draw_map(env: str, group: Group, out: Path) -> list[Path]:
    """Draw the map of the group's first run with a policy, if there is one and a maze."""
    maze = maps.maze_of(env)
    run = next((run for run in group.runs if run.has_policy), None)
    if maze is None or run is None:
        return []
    policy = rollouts.load(run)
    recordings = rollouts.record(policy, MAP_EPISODES)
    drawn = maps.draw(maze, group.label, policy, recordings)
    return style.save(drawn, out / f"{env}-{group.slug}-map")
