"""From run folders to files: the figures and the page."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from midway.errors import ConfigurationError
from midway.reports import (
    comparison,
    curves,
    difficulty,
    failures,
    health,
    images,
    imagined,
    maze,
    page,
    style,
    tabletop,
)
from midway.reports.cache import Cache
from midway.reports.page import Section, Shown
from midway.reports.runs import RunData, Runs, by_environment, read
from midway.reports.style import Picture
from midway.runs.kept import Which
from midway.training.progress import stage

PAGE = "report.html"
TABLES = "data"

Figures: TypeAlias = Callable[[Runs, Cache], Iterator[Picture]]
"""Yields the figures that the runs of one environment have; notes in the cache what is missing."""

FIGURES: tuple[Figures, ...] = (
    curves.figures,
    comparison.figures,
    maze.figures,
    failures.figures,
    difficulty.figures,
    imagined.figures,
    tabletop.figures,
    images.figures,
    health.figures,
)
"""Every figure of an environment, in the order of the page."""


def report(
    runs: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    policy: Which = "last",
    changes: Mapping[str, object] | None = None,
) -> list[Path]:
    """Draw what run folders hold, and one page with all of it.

    Args:
        runs: A run folder, or several; agents, seeds and environments may differ.
        out: Where the files go; default: ``figures`` in the run's folder, or for several runs
            ``report`` beside the first one.
        policy: Whose episodes, subgoals and values are drawn: ``last``, ``best``, or a step whose
            policy was kept.
        changes: Settings that all these policies act with, as in `midway.api.load`.

    Returns:
        The files that were written: the page, then the figures.

    Raises:
        ConfigurationError: A path is no run folder, no run has kept the policy, a setting may not
            change after training, or ``out`` cannot be written.
    """
    paths = [Path(run) for run in ([runs] if isinstance(runs, str | Path) else runs)]
    if not paths:
        raise ConfigurationError("no run folder given")
    folders = {path.resolve(): path for path in paths}
    found = [read(path, policy, changes) for path in folders.values()]
    _check_kept(found)
    alone = len(found) == 1
    place = found[0].folder.figures if alone else paths[0].resolve().parent / "report"
    place = place if out is None else Path(out)
    try:
        place.mkdir(parents=True, exist_ok=True)
        return _write(found, place)
    except OSError as error:
        raise ConfigurationError(f"cannot write the report to {place}: {error.strerror}") from error


def _check_kept(found: Sequence[RunData]) -> None:
    """Refuse a policy that no run has kept; where one has, the page says which have not."""
    errors = []
    for run in found:
        try:
            assert run.weights
        except ConfigurationError as error:
            errors.append(error)
    if len(errors) == len(found):
        raise errors[0]


def pictures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield every figure of an environment."""
    for figures in FIGURES:
        yield from figures(runs, cache)


def _write(found: Sequence[RunData], out: Path) -> list[Path]:
    environments = by_environment(found)
    overview = [
        *_drawn(curves.overview(environments), out),
        *_drawn(comparison.overview(environments), out),
    ]
    sections = [_section(runs, out) for runs in environments]
    html = page.write(out / PAGE, sections, overview)
    shown = [*overview, *(picture for section in sections for picture in section.pictures)]
    return [html, *(file for picture in shown for file in picture.files)]


def _section(runs: Runs, out: Path) -> Section:
    """Draw everything about one environment."""
    cache = Cache(out / TABLES)
    for note in _unfinished(runs):
        cache.note(note)
    drawn = _drawn(pictures(runs, cache), out)
    return Section(runs, drawn, cache.notes)


def _drawn(found: Iterator[Picture], out: Path) -> list[Shown]:
    """Draw figures one by one and write their files."""
    shown = []
    for picture in found:
        shown.append(Shown(picture, style.save(picture.draw(), out / picture.stem)))
        stage(f"drawn {picture.stem}", len(shown), len(shown))
    return shown


def _unfinished(runs: Runs) -> Iterator[str]:
    """Yield what the runs lack."""
    for group in runs.groups:
        if len(group.runs) == 1:
            yield f"{group.label}: one seed, so there is no interval over seeds"
        for run in group.runs:
            where = f"{group.label}, seed {run.config.seed}"
            yield from (f"{where}: left out: {text}" for text in run.damaged)
            if not run.finished:
                yield f"{where}: unfinished, {run.steps:,} of {run.config.train.steps:,} steps"
            if not run.evaluation:
                yield f"{where}: no evaluation yet"
    if runs.view is None:
        yield f"{runs.env} has no view, so of the policies themselves failures alone are drawn"
