"""Signals that ask a run for a checkpoint, or to end with one.

Python runs their handlers between two of its own instructions: while a program is compiled, or one
call of a simulator lasts, they wait. A thread of the command line does not.
"""

import math
import multiprocessing
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import NamedTuple

from midway.training.terminal import print_line, show_cursor

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU)
"""Signals that end a run with a checkpoint."""

IMPATIENT = (signal.SIGINT, signal.SIGTERM)
"""Those of them that end it at once the second time; the system itself may repeat the others."""

GRACE = 8.0
"""Seconds for a run to obey a signal."""

SECOND_GRACE = 1.0
"""The same for a second one."""


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

    Args:
        grace: Seconds for Python's own handler; the process ends itself after them.

    Raises:
        Ended: There was a signal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise Ended(number)

    previous = {number: signal.signal(number, end) for number in IMPATIENT}
    try:
        with _watched(_Watch(IMPATIENT, grace, lambda: "interrupted", lambda: False)):
            yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def ending_in_time(
    last_line: Callable[[], str] = lambda: "interrupted", saving: Callable[[], bool] = lambda: False
) -> AbstractContextManager[None]:
    """End a run that does not obey a signal in time: after `GRACE`, or soon after a second one.

    Files of a run are whole at any time: nothing is lost but the steps since its checkpoint.

    Args:
        last_line: What is said then.
        saving: Whether a checkpoint is being written, which is waited for.
    """
    return _watched(_Watch(ENDING, GRACE, last_line, saving))


class _Watch(NamedTuple):
    """What a thread waits for that sees signals where native code keeps Python from them.

    Attributes:
        numbers: The signals.
        grace: Seconds to obey one.
        last_line: What is said where it was not obeyed.
        saving: Whether more time is given.
    """

    numbers: tuple[int, ...]
    grace: float
    last_line: Callable[[], str]
    saving: Callable[[], bool]

    def wait(self, reading: int) -> None:
        """Read the numbers of signals, until 0; leave where one was not obeyed."""
        first, deadline, saving = 0, math.inf, self.saving
        while True:
            left = max(0.0, deadline - time.monotonic()) if first else None
            if not select.select([reading], [], [], left)[0]:
                if not saving():
                    _leave(first, self.last_line)
                    return
                deadline = time.monotonic() + self.grace
                continue
            number = os.read(reading, 1)[0]
            if number == 0:
                return
            if not first and number in self.numbers:
                first, deadline = number, time.monotonic() + self.grace
            elif first and number in IMPATIENT:
                deadline, saving = min(deadline, time.monotonic() + SECOND_GRACE), lambda: False


@contextmanager
def _watched(watch: _Watch) -> Iterator[None]:
    """Let a thread watch over what is done; outside of the main thread there are no signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    thread = threading.Thread(target=watch.wait, args=(reading,), daemon=True)
    thread.start()
    descriptor = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        os.write(writing, b"\0")
        thread.join()
        os.close(reading)
        os.close(writing)


def _leave(number: int, last_line: Callable[[], str]) -> None:
    """End this process by a signal, and those that step environments."""
    try:
        print_line(f"midway: {last_line()}")
        show_cursor()
        for process in multiprocessing.active_children():
            process.kill()
    finally:
        os._exit(128 + number)


def _is_ignored(number: int) -> bool:
    """Return whether whoever started the process wants it to outlive its terminal (nohup)."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
