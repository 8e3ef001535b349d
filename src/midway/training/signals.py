"""Signals that ask a run for a checkpoint, or to end with one.

Python runs their handlers between two of its own instructions: while a program is compiled, or one
call of a simulator lasts, they wait.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from midway.training.terminal import print_line

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU)
"""Signals that end a run with a checkpoint."""

IMPATIENT = (signal.SIGINT, signal.SIGTERM)
"""Those of them that end it at once the second time; the system itself may repeat the others."""


class Interrupted(Exception):  # noqa: N818 - nothing is wrong
    """A run shall end, in the middle of something that is done again once it goes on."""


@dataclass
class Asked:
    """What signals have asked for.

    Attributes:
        end: The signal that ends the run, once there was one.
        save: Whether a checkpoint is wanted (SIGUSR1).
    """

    end: int | None = None
    save: bool = False

    def check(self) -> None:
        """Leave what is being done, if the run shall end.

        Raises:
            Interrupted: It shall.
        """
        if self.end is not None:
            raise Interrupted


@contextmanager
def listening() -> Iterator[Asked]:
    """Take note of signals; outside of the main thread there are none."""
    asked = Asked()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = [number for number in (*ENDING, signal.SIGUSR1) if not _is_ignored(number)]
    previous = {number: signal.getsignal(number) for number in numbers}

    def note(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGUSR1:
            asked.save = True
            return
        asked.end = asked.end or number
        if number in IMPATIENT:
            for name in IMPATIENT:
                signal.signal(name, previous[name])

    for number in numbers:
        signal.signal(number, note)
    try:
        yield asked
    finally:
        for number in numbers:
            signal.signal(number, previous[number])


class Ended(KeyboardInterrupt):
    """A signal ended a command that keeps nothing.

    Attributes:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def ending_soon(grace: float = 3.0) -> Iterator[None]:
    """End what keeps nothing by the first SIGINT or SIGTERM, within some seconds at most.

    Python's handlers wait while native code runs; a thread that sees the signal does not.

    Args:
        grace: Seconds for Python's own handler; the process ends itself after them.

    Raises:
        Ended: There was a signal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    over = threading.Event()

    def watch() -> None:
        while number := os.read(reading, 1)[0]:
            if number in IMPATIENT and not over.wait(grace):
                print_line("midway: interrupted")
                os._exit(128 + number)
        os.close(reading)
        os.close(writing)

    def end(number: int, frame: FrameType | None) -> None:
        raise Ended(number)

    threading.Thread(target=watch, daemon=True).start()
    previous = {number: signal.signal(number, end) for number in IMPATIENT}
    descriptor = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in previous.items():
            signal.signal(number, handler)
        over.set()
        os.write(writing, b"\0")


def _is_ignored(number: int) -> bool:
    """Return whether whoever started the process wants it to outlive its terminal (nohup)."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
