"""What a run says on standard error while it trains."""

import sys
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from midway.training.terminal import heard, print_line


@runtime_checkable
class Reporter(Protocol):
    """Someone who is told how far a run is."""

    def message(self, text: str) -> None:
        """Say one line."""
        ...

    def advance(self, step: int, values: Mapping[str, float]) -> None:
        """Say how far the run is; values are ``steps/s`` and ``success``."""
        ...

    def close(self) -> None:
        """Stop."""
        ...


class Silent:
    """Says nothing."""

    def message(self, text: str) -> None:
        """Say nothing."""

    def advance(self, step: int, values: Mapping[str, float]) -> None:
        """Say nothing."""

    def close(self) -> None:
        """Do nothing."""


class Lines:
    """Plain lines, for output that is no terminal.

    Args:
        total: Environment steps of the run.
    """

    def __init__(self, total: int) -> None:
        self._total = total

    def message(self, text: str) -> None:
        """Print one line."""
        print_line(text)

    def advance(self, step: int, values: Mapping[str, float]) -> None:
        """Print one line of progress."""
        self.message(f"step {step}/{self._total}  {_describe(values)}")

    def close(self) -> None:
        """Do nothing."""


class Bar:
    """A progress bar with steps per second, success and the time left.

    Args:
        total: Environment steps of the run.
        done: Steps that are done already.
    """

    def __init__(self, total: int, done: int) -> None:
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[values]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task("train", total=total, completed=done, values="")
        self._progress.start()

    def message(self, text: str) -> None:
        """Print one line above the bar."""
        with heard():
            self._progress.console.print(text, markup=False, highlight=False)

    def advance(self, step: int, values: Mapping[str, float]) -> None:
        """Move the bar."""
        with heard():
            self._progress.update(self._task, completed=step, values=_describe(values))

    def close(self) -> None:
        """Leave the bar as it is."""
        with heard():
            self._progress.stop()


def reporter(total: int, done: int) -> Reporter:
    """Return a bar where standard error is a terminal, else plain lines."""
    return Bar(total, done) if sys.stderr.isatty() else Lines(total)


def _describe(values: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
