"""One HTML page that holds everything and needs nothing but itself."""

import base64
import html
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from midway.reports.curves import success_curve
from midway.reports.runs import Group, RunData

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 62rem; padding: 1.5rem; color: #222; background: #fff;
  font: 1rem/1.55 system-ui, sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 .5rem; }
h2 { font-size: 1.3rem; margin: 2.5rem 0 .5rem; border-bottom: 2px solid #e3e3e3; }
h3 { font-size: 1.05rem; margin: 2rem 0 .25rem; }
figure { margin: 0 0 1rem; }
img { display: block; max-width: 100%; height: auto; }
figcaption, .note { color: #444; max-width: 46rem; }
nav a { margin-right: 1rem; }
a { color: #005a8e; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .75rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: #444; padding-bottom: .25rem; }
th, td { padding: .3rem .8rem .3rem 0; text-align: left; border-bottom: 1px solid #e3e3e3;
  vertical-align: top; }
.missing { border-left: 4px solid #d55e00; background: #fdf3ec; padding: .5rem 1rem; }
.missing ul { margin: .25rem 0; padding-left: 1.2rem; }
pre { background: #f5f5f5; padding: .6rem .8rem; overflow-x: auto; user-select: all; }
summary { cursor: pointer; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure on the page.

    Attributes:
        file: Its PNG file.
        title: Its heading.
        caption: How to read it.
        description: What it shows, for those who do not see it.
    """

    file: Path
    title: str
    caption: str
    description: str


@dataclass(frozen=True)
class Section:
    """What there is of one environment.

    Attributes:
        title: Its heading.
        groups: The runs.
        pictures: The figures.
        missing: What could not be drawn, and why.
    """

    title: str
    groups: Sequence[Group]
    pictures: Sequence[Picture]
    missing: Sequence[str]


def write(path: Path, sections: Sequence[Section], overview: Sequence[Picture]) -> Path:
    """Write the page, images included, and return its path."""
    title = "midway: " + ", ".join(section.title for section in sections)
    parts = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<link rel="icon" href="data:,">',
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>",
        f"<main>\n<h1>{html.escape(title)}</h1>",
        *_navigation(sections),
        *(_picture(picture) for picture in overview),
        *(part for section in sections for part in _section(section)),
        "</main>\n</body>\n</html>\n",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _navigation(sections: Sequence[Section]) -> Iterator[str]:
    if len(sections) > 1:
        links = (f'<a href="#{_anchor(s.title)}">{html.escape(s.title)}</a>' for s in sections)
        yield f'<nav aria-label="environments">{" ".join(links)}</nav>'


def _section(section: Section) -> Iterator[str]:
    yield f'<section id="{_anchor(section.title)}">\n<h2>{html.escape(section.title)}</h2>'
    yield _results(section.groups)
    if section.missing:
        items = "".join(f"<li>{html.escape(note)}</li>" for note in section.missing)
        yield f'<div class="missing"><strong>What is missing</strong><ul>{items}</ul></div>'
    yield from (_picture(picture) for picture in section.pictures)
    yield "<h3>How these runs were made</h3>"
    yield from (_provenance(group) for group in section.groups)
    yield "</section>"


def _anchor(title: str) -> str:
    return html.escape(title.replace(" ", "-"), quote=True)


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.file.read_bytes()).decode("ascii")
    return (
        f"<h3>{html.escape(picture.title)}</h3>\n<figure>\n"
        f'<img src="data:image/png;base64,{data}" alt="{html.escape(picture.description)}">\n'
        f"<figcaption>{html.escape(picture.caption)}</figcaption>\n</figure>"
    )


def _results(groups: Sequence[Group]) -> str:
    """Return the table of the newest evaluations."""
    columns = [f"{task}, {actions}" for task in ("hard", "uniform") for actions in KINDS]
    header = "".join(f'<th scope="col">{name}</th>' for name in ("agent", "steps", *columns))
    rows = "".join(_result_row(group) for group in groups)
    caption = (
        "Success at the last evaluation, by task and kind of action: one seed, or the "
        "interquartile mean of several with its 95 % bootstrap interval."
    )
    return (
        f'<div class="scroll"><table>\n<caption>{caption}</caption>\n'
        f"<thead><tr>{header}</tr></thead>\n<tbody>{rows}</tbody>\n</table></div>"
    )


KINDS = ("mean", "sampled")


def _result_row(group: Group) -> str:
    cells = [
        success_text(group, task, actions) for task in ("hard", "uniform") for actions in KINDS
    ]
    steps = f"{min(run.steps for run in group.runs):,}"
    name = f'<th scope="row">{html.escape(group.label)}</th>'
    return f"<tr>{name}<td>{steps}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def success_text(group: Group, task: str, actions: str = "mean") -> str:
    """Return the success at the last step that every evaluated run has, with its interval."""
    drawn = success_curve(group, task, actions, "step")
    if drawn is None or not len(drawn.x):
        return "not evaluated"
    last = int((drawn.runs == drawn.runs.max()).nonzero()[0][-1])
    text = percent(drawn.centre[last])
    if drawn.runs[last] > 1:
        low, high = (percent(end[last]) for end in drawn.interval)
        text += f" [{low}, {high}]"
    return text


def percent(share: float) -> str:
    """Return a share as a percentage without decimals."""
    return f"{100 * share:.0f}\N{NO-BREAK SPACE}%"


def _provenance(group: Group) -> str:
    """Return commands, versions and configuration of a group, folded."""
    commands = "\n".join(dict.fromkeys(_command(run) for run in group.runs))
    first = group.runs[0]
    seeds = f"seed{'s' * (len(group.runs) > 1)} "
    seeds += ", ".join(str(run.config.seed) for run in group.runs)
    return (
        f"<details><summary>{html.escape(group.label)}, {seeds}</summary>\n"
        f"<p>Commands, as they were typed:</p>\n<pre>{html.escape(commands)}</pre>\n"
        f"{_facts(group)}\n<p>Configuration of seed {first.config.seed}:</p>\n"
        f"<pre>{html.escape(_configuration(first))}</pre>\n</details>"
    )


def _command(run: RunData) -> str:
    return str(run.record.get("command", "not recorded"))


def _facts(group: Group) -> str:
    """Return a table of folder, commit, machine and versions of every run."""
    rows = "".join(
        f'<tr><th scope="row">{run.config.seed}</th>'
        + "".join(f"<td>{html.escape(text)}</td>" for text in _fact_row(run))
        + "</tr>"
        for run in group.runs
    )
    names = ("seed", "folder", "commit", "steps", "minutes", "machine", "versions")
    header = "".join(f'<th scope="col">{name}</th>' for name in names)
    return (
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _fact_row(run: RunData) -> list[str]:
    machine = run.record.get("machine", {})
    versions = run.record.get("versions", {})
    minutes = max(
        (float(t["seconds"].max()) for t in (run.metrics, run.evaluation) if t), default=0
    )
    return [
        str(run.folder.path),
        str(run.record.get("commit") or "unknown"),
        f"{run.steps:,} of {run.config.train.steps:,}",
        f"{minutes / 60:.1f}",
        ", ".join(f"{name} {value}" for name, value in machine.items()),
        ", ".join(f"{name} {value}" for name, value in versions.items()),
    ]


def _configuration(run: RunData) -> str:
    values: dict[str, Any] = run.config.to_json()
    return json.dumps(values, indent=2)
