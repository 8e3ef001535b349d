"""Standard error that may be gone: whoever read it has ended, or its terminal was closed."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def print_line(text: str) -> None:
    """Print one line on standard error, if somebody is there."""
    with heard():
        print(text, file=sys.stderr, flush=True)


def show_cursor() -> None:
    """Show the cursor of a terminal, which a progress bar hides."""
    if sys.stderr.isatty():
        with heard():
            print("\x1b[?25h", end="", file=sys.stderr, flush=True)


@contextmanager
def heard() -> Iterator[None]:
    """Say something on standard error; once nobody is there, all that follows is thrown away."""
    try:
        yield
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)  # for libraries too, and for what Python writes at its end
        os.close(nowhere)
