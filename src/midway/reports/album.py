"""Figures on their way to files and to the page."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from midway.reports import style
from midway.reports.page import Picture


@dataclass
class Album:
    """Figures on their way to files.

    Attributes:
        out: Where the files go.
        pictures: What the page shows.
        files: The files that were written.
        missing: What could not be drawn, and why.
    """

    out: Path
    pictures: list[Picture] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def add(
        self, name: str, draw: Callable[[], Figure], title: str, caption: str, description: str
    ) -> None:
        """Draw a figure and write its files."""
        files = style.save(draw(), self.out / name)
        self.files += files
        self.pictures.append(Picture(files[0], title, caption, description))
