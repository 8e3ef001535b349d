"""How figures look: size, colours, labels. Drawn through matplotlib's objects, without pyplot."""

import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from midway.agents.registry import AGENTS

WIDTH = 9.0
"""Width of a figure that fills a page (inches): 10-point text is still readable on a laptop."""

RESOLUTION = 150
"""Pixels per inch of PNG files."""

NARROW, WIDE = 30, 44
"""Letters in a line of a panel's title and of a legend's entry, at most."""

TITLE_LETTERS = 11.0
"""Letters of a title in an inch."""

LEGEND_LETTERS = 16.0
"""Letters of a legend in an inch."""

TEXT, SMALL = 10.0, 8.5
"""Sizes of titles and axis labels, and of everything else (points)."""

INK, MUTED, GRID = "#222222", "#595959", "#e3e3e3"
"""Colours of text, of secondary text (contrast 7:1 on white), and of lines behind the data."""

BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PURPLE, SKY, BLACK = "#cc79a7", "#56b4e9", "#000000"
"""The palette of Okabe and Ito, which colour-blind readers can tell apart."""

PALETTE = (BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE, BLACK)
"""Colours of groups of runs, in the order in which they are given out."""

AGENT_COLOURS = dict(zip(AGENTS, PALETTE, strict=False))
"""An agent of this package has the same colour in every figure; others get what is left."""

Look: TypeAlias = dict[str, Any]
"""How marks, lines or words look: arguments of matplotlib."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Marks that tell groups apart without colour."""


@dataclass(frozen=True)
class Picture:
    """A figure with its words.

    Attributes:
        stem: Its file name without an ending.
        draw: Draws it.
        title: Its heading on the page.
        caption: How to read it.
        description: What it shows, for those who do not see it.
        conclusion: What to conclude from it.
    """

    stem: str
    draw: Callable[[], Figure]
    title: str
    caption: str
    description: str
    conclusion: str = ""


def file_name(text: str) -> str:
    """Return text as part of a file name: only letters, digits, ``.``, ``_`` and ``-`` stay."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip(".-") or "unnamed"


def colours(preferred: Sequence[str | None]) -> list[str]:
    """Return a colour for each group: the preferred one, or the next that no other group has."""
    free = [colour for colour in PALETTE if colour not in preferred] or list(PALETTE)
    rest: Iterator[str] = iter(free * len(preferred))
    return [colour or next(rest) for colour in preferred]


def percent(share: float) -> str:
    """Return a share as a percentage without decimals."""
    return f"{100 * share:.0f}\N{NO-BREAK SPACE}%"


def thousands(value: float | int, position: object = None) -> str:
    """Return a number of steps in short: 8k, 1.5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def figure(
    rows: int, columns: int, height: float, width: float = WIDTH, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure (inches) and its axes, row by row, in the style of the project."""
    drawn = Figure((width, height), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = list(np.ravel(drawn.subplots(rows, columns, squeeze=False, **options)))
    for each in axes:
        tidy(each)
    return drawn, axes


def tidy(axes: Axes) -> None:
    """Show two spines, a pale grid behind the data, and small numbers."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL, color=MUTED, labelcolor=INK)


def label(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Write the title, flush left, and the names of the axes with their units."""
    axes.set_title(title, fontsize=TEXT, color=INK, loc="left", weight="bold")
    axes.set_xlabel(x, fontsize=TEXT, color=INK)
    axes.set_ylabel(y, fontsize=TEXT, color=INK)


def caption(axes: Axes, *lines: str) -> None:
    """Write a title in the middle, for panels that look alike, as wide as a column of them."""
    place, figure = axes.get_subplotspec(), axes.get_figure(root=True)
    columns = place.get_gridspec().ncols if place else 1
    width = figure.get_figwidth() if figure else WIDTH
    letters = min(NARROW, int(TITLE_LETTERS * width / columns))
    wrapped = [textwrap.fill(line, letters) for line in lines]
    axes.set_title("\n".join(wrapped), fontsize=TEXT, color=INK)


def success_axis(axes: Axes) -> None:
    """Let y run from 0 to 100 % with room for the lines at both ends."""
    axes.set_ylim(-0.03, 1.03)
    axes.set_yticks(np.linspace(0, 1, 5), ["0 %", "25 %", "50 %", "75 %", "100 %"])


def legend_below(drawn: Figure, handles: Sequence[Artist], title: str = "") -> None:
    """Put one legend under all panels; long names take several lines."""
    names = [textwrap.fill(str(handle.get_label()), WIDE) for handle in handles]
    columns = int(LEGEND_LETTERS * drawn.get_figwidth()) // (max(map(len, names)) + 6)
    drawn.legend(
        list(handles),
        names,
        loc="outside lower center",
        ncols=max(1, min(columns, len(handles))),
        title=title,
        title_fontsize=SMALL + 0.5,
        frameon=False,
        fontsize=SMALL + 0.5,
        labelcolor=INK,
    )


def settle(drawn: Figure) -> None:
    """Find the places of the panels, once, so that all words are on the canvas.

    A panel of a fixed aspect would be measured while it is smaller than its place, and what is
    missing around it would be taken for room for titles: it is measured as large as its place.
    """
    engine = drawn.get_layout_engine()
    assert engine is not None
    aspects = {axes: axes.get_aspect() for axes in drawn.axes}
    for axes in aspects:
        axes.set_aspect("auto")
    engine.execute(drawn)
    drawn.set_layout_engine("none")
    for axes, aspect in aspects.items():
        axes.set_aspect(aspect)


def save(drawn: Figure, path: Path) -> list[Path]:
    """Write ``path`` as PNG and as SVG; return both files."""
    files = [path.with_name(path.name + suffix) for suffix in (".png", ".svg")]
    drawn.set_dpi(RESOLUTION)
    settle(drawn)
    drawn.savefig(files[0], dpi=RESOLUTION, facecolor="white")
    drawn.savefig(files[1], dpi=RESOLUTION, facecolor="white", metadata={"Date": None})
    return files
