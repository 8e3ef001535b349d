"""From run folders to files: the figures and the page."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from midway.envs.registry import ENVIRONMENTS
from midway.reports import (
    arm,
    curves,
    difficulty,
    health,
    imagined,
    maps,
    page,
    reconstructions,
    tabletop,
)
from midway.reports.album import Album
from midway.reports.page import Section
from midway.reports.runs import Group, RunData, groups, read
from midway.reports.study import Study, maze_of
from midway.types import ConfigurationError

PAGE = "report.html"
TABLES = "data"


def report(paths: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Draw what run folders hold, and one page with all of it.

    Args:
        paths: Run folders; agents, seeds and environments may differ.
        out: Where the files go; default: ``figures`` in the run's folder, or for several runs
            ``report`` beside the first one.

    Returns:
        The files that were written: the page, then the figures.

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
        return _write(runs, out)
    except OSError as error:
        raise ConfigurationError(f"cannot write the report to {out}: {error.strerror}") from error


def _write(runs: Sequence[RunData], out: Path) -> list[Path]:
    known = list(ENVIRONMENTS)
    names = sorted({run.config.env for run in runs}, key=known.index)
    by_env = {env: groups([run for run in runs if run.config.env == env]) for env in names}
    overview = Album(out)
    if len(by_env) > 1:
        overview.add(
            "all-learning-curves",
            lambda: curves.draw_overview(by_env),
            "All environments",
            "Success of mean actions over environment steps, interquartile mean over seeds with "
            "stratified 95 % bootstrap intervals; all environments together where they have the "
            "same agents.",
            "Learning curves of every environment.",
        )
    chapters = [_chapter(env, gathered, out) for env, gathered in by_env.items()]
    sections = [section for section, _ in chapters]
    html = page.write(out / PAGE, sections, overview.pictures)
    return [html, *overview.files, *(file for _, files in chapters for file in files)]


def _chapter(env: str, gathered: Sequence[Group], out: Path) -> tuple[Section, list[Path]]:
    """Draw everything about one environment."""
    album = Album(out)
    album.missing += _unfinished(gathered)
    _add_curves(album, env, gathered)
    if maze_of(env) is not None:
        _add_studies(album, env, gathered)
    elif tabletop.has_table(env):
        arm.add(album, env, gathered)
    else:
        album.missing.append(f"{env} has no maze: no maps, difficulty or values")
    _add_reconstructions(album, env, gathered)
    _add_health(album, env, gathered)
    return Section(env, gathered, album.pictures, album.missing), album.files


def _add_reconstructions(album: Album, env: str, gathered: Sequence[Group]) -> None:
    """Draw what autoencoders keep of states."""
    for group in gathered:
        for run in list(filter(reconstructions.has_autoencoder, group.runs))[:1]:
            album.add(
                f"{env}-{group.slug}-reconstructions",
                lambda run=run, group=group: reconstructions.draw(run, group.label),  # type: ignore[misc]
                f"What the autoencoder of {group.label} keeps",
                "New states of the environment, and what is decoded from their latent numbers: "
                f"{group.label} plans its subgoals in these (seed {run.config.seed}).",
                f"States of {env} and their reconstructions.",
            )


def _unfinished(gathered: Sequence[Group]) -> Iterator[str]:
    """Yield what the runs lack."""
    for group in gathered:
        if len(group.runs) == 1:
            yield f"{group.label}: one seed, so there is no interval over seeds"
        for run in group.runs:
            where = f"{group.label}, seed {run.config.seed}"
            if not run.finished:
                yield f"{where}: unfinished, {run.steps:,} of {run.config.train.steps:,} steps"
            if not run.evaluation:
                yield f"{where}: no evaluation yet"


def _add_curves(album: Album, env: str, gathered: Sequence[Group]) -> None:
    if not any(run.evaluation for group in gathered for run in group.runs):
        album.missing.append("no run has been evaluated: no learning curves")
        return
    album.add(
        f"{env}-learning-curves",
        lambda: curves.draw(gathered),
        "Learning curves",
        "Success over environment steps (top) and over the time spent on collection and updates, "
        "without evaluations (bottom). Lines: one seed, or the interquartile mean of several; "
        "shaded: its 95 % bootstrap interval. Over time, seeds are compared along straight lines "
        "between their evaluations, and a seed that is done keeps its last success.",
        f"Learning curves on {env}. Last success: "
        + "; ".join(
            f"{group.label} hard {page.success_text(group, 'hard')}, "
            f"uniform {page.success_text(group, 'uniform')}"
            for group in gathered
        ),
    )


def _add_health(album: Album, env: str, gathered: Sequence[Group]) -> None:
    shown = health.panels(gathered)
    if not shown:
        album.missing.append("no run has metrics yet: no training health")
        return
    lines = " ".join(panel.healthy for panel in shown)
    album.add(
        f"{env}-health",
        lambda: health.draw(gathered),
        "Training health",
        "One line for each seed; the grey text says what a healthy curve looks like. "
        "Dotted: the bounds of the values.",
        f"{len(shown)} quantities over environment steps: "
        f"{', '.join(panel.title for panel in shown)}. Healthy: {lines}",
    )


def _add_studies(album: Album, env: str, gathered: Sequence[Group]) -> None:
    """Draw what the saved policies do and imagine."""
    studies = {group.label: _studies(group, album) for group in gathered}
    firsts = {group.label: (group, s[0]) for group in gathered if (s := studies[group.label])}
    if not firsts:
        return
    for group, study in firsts.values():
        _add_map(album, env, group, study)
    _add_difficulty(album, env, gathered, studies)
    for group, study in firsts.values():
        if study.imagines:
            _add_subgoals(album, env, group, study)
    judged = {label: study for label, (_, study) in firsts.items() if study.judges}
    for unit in dict.fromkeys(study.value_unit for study in judged.values()):
        alike = {label: study for label, study in judged.items() if study.value_unit == unit}
        _add_values(album, env, unit, alike)


def _studies(group: Group, album: Album) -> list[Study]:
    """Return the studies of the runs whose policies can be used."""
    studies = []
    for run in group.runs:
        where = f"{group.label}, seed {run.config.seed}"
        if not run.has_policy:
            album.missing.append(f"{where}: no policy saved yet, so it is on no map")
            continue
        try:
            study = Study(run, album.out / TABLES)
            study.episodes()
            studies.append(study)
        except ConfigurationError as error:
            album.missing.append(f"{where}: the policy cannot be used: {error}")
    return studies


def _seed(study: Study) -> str:
    return f"seed {study.run.config.seed}, step {study.run.policy_step:,}"


def _add_map(album: Album, env: str, group: Group, study: Study) -> None:
    rates = {
        task: page.percent(sum(e.success for e in chosen) / len(chosen))
        for task in maps.SHOWN
        for chosen in [[e for e in study.episodes() if e.task == task]]
    }
    album.add(
        f"{env}-{group.slug}-map",
        lambda: maps.draw(study, group.label),
        f"{group.label} in the maze",
        f"Ways of mean actions ({_seed(study)}). Walls are grey; an episode ends within 0.5 m of "
        "its goal."
        + (" The subgoals are drawn by the subgoal policy at a start." if study.imagines else "")
        + (" The plan is that of an episode from the middle of the start." if study.plans else "")
        + _flips(env, study),
        f"Map of {env} with the ways of {group.label}; success over all recorded episodes: "
        f"hard {rates['hard']}, uniform {rates['uniform']}.",
    )


def _flips(env: str, study: Study) -> str:
    """Return how often the ant lies on its back at the end."""
    if not env.startswith("ant-"):
        return ""
    flipped = [episode.flipped for episode in study.episodes()]
    return (
        f" The ant ends on its back in {page.percent(sum(flipped) / len(flipped))} of "
        f"{len(flipped)} recorded episodes."
    )


def _add_difficulty(
    album: Album, env: str, gathered: Sequence[Group], studies: dict[str, list[Study]]
) -> None:
    results = {
        group.label: (group, [study.episodes() for study in studies[group.label]])
        for group in gathered
        if studies[group.label]
    }
    maze = next(study for of_group in studies.values() for study in of_group).maze
    cases = [name for name in maze.cases if name.startswith("case-")]
    album.add(
        f"{env}-difficulty",
        lambda: difficulty.draw(results, cases),
        "Success against difficulty",
        "Mean actions of the saved policies, the same starts and goals for all. Each bin of "
        "uniform tasks holds as many episodes. Bars: 95 % intervals, over seeds by bootstrap; of "
        "a single seed over its episodes (Wilson).",
        f"Success on {env} by length of the shortest path"
        + (" and by numbered case." if cases else "."),
    )


def _add_subgoals(album: Album, env: str, group: Group, study: Study) -> None:
    moments = len(study.subgoals()["step"])
    if moments == 1:
        album.missing.append(
            f"{group.label}, seed {study.run.config.seed}: no past policies were kept, so "
            "imagined subgoals are shown at the last step only"
        )
    album.add(
        f"{env}-{group.slug}-subgoals",
        lambda: imagined.draw_subgoals(study, group.label),
        f"What {group.label} imagines",
        f"Where the subgoal policy puts subgoals of the hard task ({_seed(study)}), and the chain "
        "that comes from imagining again between start, subgoals and goal: the largest mark is "
        "the first subgoal, smaller ones halve what is left.",
        f"Heat map of imagined subgoals at {moments} moments of training, and the subgoal chain.",
    )


def _add_values(album: Album, env: str, unit: str, studies: dict[str, Study]) -> None:
    agents = dict.fromkeys(study.run.config.agent for study in studies.values())
    album.add(
        f"{env}-{'-'.join(agents)}-values",
        lambda: imagined.draw_values(studies, unit),
        f"Value of a goal: {', '.join(studies)}",
        "Value of every place for the goal of the hard task, from which the agent starts at rest. "
        "Bright: near by its own reckoning; a sound value follows the corridors, not the straight "
        "line.",
        f"Map of {unit} for {', '.join(studies)} on {env}.",
    )
