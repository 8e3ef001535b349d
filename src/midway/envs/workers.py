"""Groups of environments in processes of their own, through Gymnasium's AsyncVectorEnv."""

import atexit
import contextlib
import functools
import json
import multiprocessing.connection
import multiprocessing.util
import sys
import tempfile
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from midway.envs.group import Group
from midway.envs.reading import Array
from midway.types import (
    NamedValues,
    OwnEnv,
)

Answer: TypeAlias = tuple[dict[str, Array], dict[int, str]]
"""What all environments show, and what those raised that broke."""

PATIENCE = 5.0
"""Seconds that a process may take to close its environments before it is killed."""


class LostError(Exception):
    """A process that steps environments does not answer, or has ended.

    Attributes:
        copies: The environments that it was asking, or all of its own.
    """

    def __init__(self, copies: list[int], reason: str) -> None:
        super().__init__(reason)
        self.copies = copies


class Workers:
    """Environments in groups of the same size, each group in a process of its own.

    The processes are started anew (JAX has threads, which a fork would not survive), without the
    user's script: no ``if __name__ == "__main__"`` is needed. Once one is lost, all are ended, and
    the next reset, which must be one of all environments, starts others.

    Args:
        make_group: ``(first=, size=, busy=) -> Group``.
        total: Number of environments.
        count: Number of processes, at most.
        limit: Seconds that a step or a reset of them all may take.
    """

    def __init__(
        self, make_group: Callable[..., Group], total: int, count: int, limit: float
    ) -> None:
        self.total, self.limit = total, limit
        self.size = -(-total // count)
        shared = tempfile.NamedTemporaryFile()  # noqa: SIM115 - as long as the processes
        self._forget = weakref.finalize(self, shared.close)
        shared.truncate(total)
        self._busy = np.memmap(shared.name, np.uint8, "r", shape=(total,))
        self._makers = [
            functools.partial(make_group, first=first, size=self.size, busy=shared.name)
            for first in range(0, total, self.size)
        ]
        self._vector: OwnEnv = None
        self._start()

    def _start(self) -> None:
        with _without_script():
            self._vector = AsyncVectorEnv(
                self._makers, context="spawn", copy=False, autoreset_mode=AutoresetMode.DISABLED
            )
        self._finalizer = weakref.finalize(self, _shut, self._vector)
        _OPEN.add(self)
        self._ask(lambda: self._vector.call("work_alone"))

    def reset(self, mask: Array, seeds: Array) -> Answer:
        """Start new episodes in the environments of the mask; return what all of them show.

        Raises:
            LostError: A process does not answer in time, or has ended.
        """
        if self._vector is None:
            self._start()
        self._vector.reset_async(options={"mask": mask, "seeds": seeds})
        return self._flat(self._ask(lambda: self._vector.reset_wait(self.limit)))

    def step(self, actions: Array) -> Answer:
        """Move every environment by one step; return what they show.

        Raises:
            LostError: A process does not answer in time, or has ended.
        """
        groups = np.zeros(self._vector.action_space.shape or (), np.float32)
        groups.reshape(-1, actions.shape[-1])[: self.total] = actions

        def answer() -> object:
            self._vector.step_async(groups)
            return self._vector.step_wait(self.limit)

        return self._flat(self._ask(answer))

    def close(self) -> None:
        """End the processes; those that do not end in time are killed."""
        self._finalizer()
        self._forget()

    def _flat(self, answer: tuple[Any, ...]) -> Answer:
        """Return what all environments show, and what they raised by their numbers."""
        shown = {
            name: batch.reshape(-1, *batch.shape[2:])[: self.total]
            for name, batch in answer[0].items()
        }
        texts = [json.loads(text) for text in answer[-1].get("raised", ()) if text]
        return shown, {int(copy): said for text in texts for copy, said in text.items()}

    def _ask(self, question: Callable[[], OwnEnv]) -> OwnEnv:
        """Ask all processes something.

        Raises:
            LostError: One does not answer in time, or has ended.
        """
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*ERROR: ")  # tracebacks, in words
                return question()
        except multiprocessing.TimeoutError as error:
            silent = [not pipe.poll(0) for pipe in self._vector.parent_pipes]
            raise self._lost(silent, f"no answer in {self.limit:g} s") from error
        except (EOFError, ConnectionError) as error:
            processes = self._vector.processes
            # One that has just ended may still count as alive; its sentinel says that it has ended.
            gone = multiprocessing.connection.wait([p.sentinel for p in processes], PATIENCE)
            ended = [process.sentinel in gone for process in processes]
            reason = "a process that steps environments has ended (killed, or out of memory?)"
            raise self._lost(ended, reason) from error

    def _lost(self, groups: list[bool], reason: str) -> LostError:
        """End all processes, and name the environments that some of them were asking."""
        copies = [copy for copy in range(self.total) if groups[copy // self.size]]
        asked = [copy for copy in copies if self._busy[copy]]
        self._finalizer.detach()
        _kill(self._vector)
        self._vector = None
        return LostError(asked or copies or [0], reason)


_OPEN: "weakref.WeakSet[Workers]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what is open before multiprocessing waits for its processes, which ignore signals."""
    for workers in list(_OPEN):
        workers.close()


def _kill(vector: OwnEnv) -> None:
    """End the processes of a vector environment at once."""
    vector.closed = True
    for process in vector.processes:
        process.kill()
        process.join()
    for pipe in vector.parent_pipes:
        with contextlib.suppress(OSError, AttributeError):  # it is gone already, or None
            pipe.close()


def _shut(vector: OwnEnv) -> None:
    """End the processes of a vector environment, whatever they are doing."""
    vector.closed = True
    for pipe in vector.parent_pipes:
        with contextlib.suppress(OSError, AttributeError):  # it is gone already, or None
            pipe.send(("close", None))
    for process in vector.processes:
        process.join(PATIENCE)
    _kill(vector)


@contextlib.contextmanager
def _without_script() -> Iterator[None]:
    """Hide the user's script from new processes, which would run it again."""
    script = sys.modules["__main__"]
    names = ("__file__", "__spec__")
    hidden: NamedValues = {name: vars(script)[name] for name in names if name in vars(script)}
    try:
        vars(script).pop("__file__", None)
        script.__spec__ = None
        yield
    finally:
        vars(script).update(hidden)


# Imported before _close_all is registered, multiprocessing's own exit function runs after it.
assert multiprocessing.util is not None
