"""Many runs: environments x agents x seeds, on the cores of this machine or on a Ray cluster.

Each run is a run folder below the sweep's folder. A sweep that is started again skips what is
finished and resumes what was interrupted.
"""

import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from midway.cluster import on_ray
from midway.cluster.jobs import (
    POLL_SECONDS,
    Job,
    Processes,
    State,
    execute,
    finished,
    last_line,
    last_success,
)
from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder
from midway.statistics import Estimate

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Status:
    """How far a run is.

    Attributes:
        job: The run.
        state: Whether it waits, runs, is finished or has failed.
        step: Environment steps at its last evaluation.
        success: Its success on the hard task (uniform where there is none), mean actions, with the
            95 % interval.
        reason: The last line of its log, where it has failed.
    """

    job: Job
    state: State
    step: int | None
    success: Estimate | None
    reason: str = ""


def jobs(
    envs: Sequence[str], agents: Sequence[str], seeds: Sequence[int], options: Sequence[str] = ()
) -> list[Job]:
    """Return every combination, seeds innermost."""
    return [Job(e, a, s, tuple(options)) for e in envs for a in agents for s in seeds]


def run(
    wanted: Sequence[Job],
    folder: Path,
    show: Callable[[list[Status]], None],
    ray_address: str | None = None,
) -> list[Status]:
    """Run all jobs and return how each ended.

    Args:
        wanted: The jobs.
        folder: Their folder; on a cluster, one that all machines share.
        show: Is told about all jobs every second.
        ray_address: Address of a Ray cluster, ``auto`` for the one of this machine; none: the
            cores of this machine, one job on each.

    Raises:
        ConfigurationError: The folder cannot be made, or Ray is missing or not reached.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"cannot make sweep folder {folder}: {error.strerror}") from error
    states: dict[Job, State] = dict.fromkeys(wanted, "waiting")
    if ray_address is None:
        processes = Processes()
        workers = _local_workers(wanted, folder, states, processes)
        with ending(processes):
            _watch(workers, folder, states, show)
    else:
        _watch(on_ray.start(wanted, folder, states, ray_address), folder, states, show)
    final = statuses(folder, states)
    show(final)
    return final


def _watch(
    workers: Sequence[threading.Thread],
    folder: Path,
    states: dict[Job, State],
    show: Callable[[list[Status]], None],
) -> None:
    for worker in workers:
        worker.start()
    while any(worker.is_alive() for worker in workers):
        show(statuses(folder, states))
        time.sleep(POLL_SECONDS)


@contextmanager
def ending(processes: Processes) -> Iterator[None]:
    """Let the first signal end all runs with a checkpoint, and the second one at once.

    Raises:
        KeyboardInterrupt: There was a second signal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def note(number: int, frame: FrameType | None) -> None:
        if processes.ending.is_set():
            processes.kill()
            raise KeyboardInterrupt
        processes.end()

    previous = {name: signal.signal(name, note) for name in names}
    try:
        yield
    finally:
        for name in names:
            signal.signal(name, previous[name])


def statuses(folder: Path, states: dict[Job, State]) -> list[Status]:
    """Return the state of every job, with the last line of its evaluations."""
    found = []
    for job, state in dict(states).items():
        step, success = last_success(RunFolder(folder / job.name).evaluation_file)
        reason = last_line(folder, job) if state == "failed" else ""
        found.append(Status(job, state, step, success, reason))
    return found


def _local_workers(
    wanted: Sequence[Job], folder: Path, states: dict[Job, State], processes: Processes
) -> list[threading.Thread]:
    """Return one thread for each core; each takes jobs until none is left."""
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in wanted:
        waiting.put(job)

    def work(core: int) -> None:
        while not processes.ending.is_set():
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                return
            states[job] = "running"
            done = finished(job, folder)
            states[job] = "finished" if done else execute(job, folder, core, processes)

    cores = sorted(os.sched_getaffinity(0))
    return [threading.Thread(target=work, args=(core,), daemon=True) for core in cores]


class Lines:
    """Says one line for each run whose state or last evaluation is another than before.

    Args:
        say: Is told each line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._before: dict[Job, Status] = {}

    def __call__(self, found: Sequence[Status]) -> None:
        """Say what is new."""
        for status in found:
            if self._before.get(status.job) != status:
                self._before[status.job] = status
                self._say(_line(status))


def _line(status: Status) -> str:
    success = "" if status.success is None else f"success {status.success:.0%}"
    step = "" if status.step is None else f"step {status.step}"
    words = (status.job.name, status.state, step, success, status.reason)
    return "  ".join(word for word in words if word)


def table(found: Sequence[Status]) -> "Table":
    """Return a table of all jobs for a terminal."""
    from rich.table import Table

    view = Table("run", "state", "step", "success", "why")
    for status in found:
        step = "" if status.step is None else str(status.step)
        success = "" if status.success is None else f"{status.success:.0%}"
        view.add_row(status.job.name, status.state, step, success, status.reason)
    return view
