"""Groups of environments in processes of their own, through Gymnasium's AsyncVectorEnv."""

import atexit
import contextlib
import functools
import multiprocessing.util
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from midway.envs.group import Group
from midway.envs.reading import Array
from midway.errors import BrokenEnvironmentError

PATIENCE = 5.0
"""Seconds that a process may take to close its environments before it is killed."""


class Workers:
    """Environments in groups of the same size, each group in a process of its own.

    The processes are started anew (JAX has threads, which a fork would not survive), without the
    user's script: no ``if __name__ == "__main__"`` is needed.

    Args:
        make_group: ``(first=, size=) -> Group``.
        total: Number of environments.
        count: Number of processes, at most.
    """

    def __init__(self, make_group: Callable[..., Group], total: int, count: int) -> None:
        self.total = total
        self.size = -(-total // count)
        makers = [
            functools.partial(make_group, first=first, size=self.size)
            for first in range(0, total, self.size)
        ]
        with _without_script():
            self._vector = AsyncVectorEnv(
                makers, context="spawn", copy=False, autoreset_mode=AutoresetMode.DISABLED
            )
        self._finalizer = weakref.finalize(self, _shut, self._vector)
        _OPEN.add(self)
        self._ask(lambda: self._vector.call("work_alone"))

    def reset(self, mask: Array, seeds: Array) -> dict[str, Array]:
        """Start new episodes in the environments of the mask; return what all of them show."""
        options = {"mask": mask, "seeds": seeds}
        return self._flat(self._ask(lambda: self._vector.reset(options=options)))

    def step(self, actions: Array) -> dict[str, Array]:
        """Move every environment by one step; return what they show."""
        groups = np.zeros(self._vector.action_space.shape or (), np.float32)
        groups.reshape(-1, actions.shape[-1])[: self.total] = actions
        return self._flat(self._ask(lambda: self._vector.step(groups)))

    def close(self) -> None:
        """End the processes; those that do not end in time are killed."""
        self._finalizer()

    def _flat(self, answer: tuple[Any, ...]) -> dict[str, Array]:
        return {
            name: batch.reshape(-1, *batch.shape[2:])[: self.total]
            for name, batch in answer[0].items()
        }

    def _ask(self, question: Callable[[], Any]) -> Any:
        """Ask all processes something.

        Raises:
            BrokenEnvironmentError: An environment raised, or its process has ended.
        """
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*ERROR: ")  # tracebacks, in words
                return question()
        except (EOFError, ConnectionError) as error:
            raise BrokenEnvironmentError(
                "a process that steps environments has ended (killed, or out of memory?)"
            ) from error


_OPEN: "weakref.WeakSet[Workers]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what is open before multiprocessing waits for its processes, which ignore signals."""
    for workers in list(_OPEN):
        workers.close()


def _shut(vector: Any) -> None:
    """End the processes of a vector environment, whatever they are doing."""
    vector.closed = True
    for pipe in vector.parent_pipes:
        with contextlib.suppress(OSError, AttributeError):  # it is gone already, or None
            pipe.send(("close", None))
    for process in vector.processes:
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()
    for pipe in vector.parent_pipes:
        with contextlib.suppress(OSError, AttributeError):
            pipe.close()


@contextlib.contextmanager
def _without_script() -> Iterator[None]:
    """Hide the user's script from new processes, which would run it again."""
    script = sys.modules["__main__"]
    names = ("__file__", "__spec__")
    hidden: dict[str, Any] = {name: vars(script)[name] for name in names if name in vars(script)}
    try:
        vars(script).pop("__file__", None)
        script.__spec__ = None
        yield
    finally:
        vars(script).update(hidden)


# Imported before _close_all is registered, multiprocessing's own exit function runs after it.
assert multiprocessing.util is not None
