"""One HTML page that holds everything and needs nothing but itself."""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import jinja2

from midway.reports.curves import success_text
from midway.reports.runs import Group, RunData, Runs
from midway.reports.style import Picture

TEMPLATE = "page.html"
STYLE = "page.css"

COLUMNS = {
    "hard, deterministic": ("hard", "mean"),
    "hard, sampled": ("hard", "sampled"),
    "uniform, deterministic": ("uniform", "mean"),
    "uniform, sampled": ("uniform", "sampled"),
}
"""Columns of the table of success: task and kind of action."""

FACTS = ("seed", "folder", "commit", "steps", "minutes", "machine", "versions")
"""Columns of the table of runs."""


@dataclass(frozen=True)
class Shown:
    """A figure on the page.

    Attributes:
        picture: The figure with its words.
        files: Its files, the PNG first.
    """

    picture: Picture
    files: Sequence[Path]

    @property
    def data(self) -> str:
        """The PNG file as a data URL."""
        return "data:image/png;base64," + base64.b64encode(self.files[0].read_bytes()).decode()


@dataclass(frozen=True)
class Section:
    """What there is of one environment.

    Attributes:
        runs: The runs.
        pictures: The figures.
        missing: What could not be drawn, and why.
    """

    runs: Runs
    pictures: Sequence[Shown]
    missing: Sequence[str]


def write(path: Path, sections: Sequence[Section], overview: Sequence[Shown]) -> Path:
    """Write the page, images included, and return its path."""
    here = resources.files("midway.reports")
    look = here.joinpath(STYLE).read_text(encoding="utf-8")
    # Everything that is filled in is escaped, and no browser runs or fetches anything.
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(here.joinpath(TEMPLATE).read_text(encoding="utf-8"))
    html = template.render(
        title="midway: " + ", ".join(section.runs.env for section in sections),
        style=look,
        policy=_policy(look),
        sections=sections,
        overview=overview,
        columns=COLUMNS,
        facts=FACTS,
        success=success_text,
        fact_row=fact_row,
        commands=commands,
        configuration=configuration,
    )
    path.write_text(html, encoding="utf-8")
    return path


def _policy(look: str) -> str:
    """Return the content security policy: this style, images inside the page, and nothing else."""
    digest = base64.b64encode(hashlib.sha256(look.encode()).digest()).decode()
    return f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"


def commands(group: Group) -> str:
    """Return the commands that made the runs, each once."""
    typed = (str(run.record.get("command", "not recorded")) for run in group.runs)
    return "\n".join(dict.fromkeys(typed))


def fact_row(run: RunData) -> list[str]:
    """Return folder, commit, machine and versions of a run, as ``FACTS`` names them."""
    tables = [table for table in (run.metrics, run.evaluation) if table]
    seconds = max((float(table["seconds"].max()) for table in tables), default=0)
    return [
        str(run.config.seed),
        str(run.folder.path),
        str(run.record.get("commit") or "unknown"),
        f"{run.steps:,} of {run.config.train.steps:,}",
        f"{seconds / 60:.1f}",
        _listed(run.record.get("machine")),
        _listed(run.record.get("versions")),
    ]


def _listed(values: object) -> str:
    """Return names and values in one line."""
    if not isinstance(values, dict):
        return "" if values is None else str(values)
    return ", ".join(f"{name} {value}" for name, value in values.items())


def configuration(run: RunData) -> str:
    """Return the whole configuration of a run as JSON."""
    return json.dumps(run.config.to_json(), indent=2)
