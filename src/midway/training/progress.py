"""What is said on standard error while a run trains, or something else takes long."""

import itertools
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol, cast, runtime_checkable

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

STAGES = logging.getLogger("midway.stages")
"""How far long actions are; nothing is shown unless `showing_stages` asks for it."""


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
        self._progress = _bar("{task.fields[values]}")
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


def stage(name: str, done: int, total: int) -> None:
    """Say how far a long action is that is no training."""
    STAGES.info("%s: %d of %d", name, done, total)


def stages_of(name: str, steps: int) -> Callable[[], None]:
    """Return what is called after each step, and says after every tenth part how far it is."""
    taken = itertools.count(1)

    def tell() -> None:
        done = next(taken)
        if done % max(1, steps // 10) == 0:
            stage(name, done, steps)

    return tell


class _StageBar(logging.Handler):
    """Shows the stage that was said last as one bar."""

    def __init__(self) -> None:
        super().__init__()
        self._progress = _bar("{task.description}")
        self._task = self._progress.add_task("", total=None)
        self._progress.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Move the bar."""
        name, done, total = cast(tuple[str, int, int], record.args)
        with heard():
            self._progress.update(self._task, description=name, completed=done, total=total)

    def close(self) -> None:
        """Take the bar away."""
        with heard():
            self._progress.stop()
        super().close()


class _StageLines(logging.Handler):
    """Prints a line for each stage."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one line."""
        print_line(record.getMessage())


@contextmanager
def showing_stages() -> Iterator[None]:
    """Show how far long actions are: a bar where standard error is a terminal, else lines."""
    handler = _StageBar() if sys.stderr.isatty() else _StageLines()
    STAGES.addHandler(handler)
    STAGES.setLevel(logging.INFO)
    STAGES.propagate = False
    try:
        yield
    finally:
        STAGES.removeHandler(handler)
        STAGES.setLevel(logging.NOTSET)
        STAGES.propagate = True
        handler.close()


def _bar(text: str) -> Progress:
    """Return a bar with a text of its task, on standard error."""
    return Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(text),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


def _describe(values: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
