"""Many runs: environments x agents x seeds, on the cores of this machine or on a Ray cluster.

Each run is a run folder below the sweep's folder. A sweep that is started again skips what is
finished and resumes what was interrupted.
"""

import csv
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from midway.training.folder import RunFolder
from midway.types import ConfigurationError

State: TypeAlias = Literal["waiting", "running", "finished", "failed"]

POLL_SECONDS = 1.0
RELEASE_SECONDS = 120.0


@dataclass(frozen=True)
class Job:
    """One run of a sweep.

    Attributes:
        env: Environment name.
        agent: Agent name.
        seed: Its seed.
        options: Further options of ``midway train``.
        label: Tells runs apart that differ in their options alone.
    """

    env: str
    agent: str
    seed: int
    options: tuple[str, ...] = ()
    label: str = ""

    @property
    def name(self) -> str:
        """Name of its run folder."""
        parts = (self.env.replace("/", "-"), self.agent, self.label, f"seed{self.seed}")
        return "-".join(part for part in parts if part)

    def command(self, folder: Path) -> list[str]:
        """Return the command that starts the run, or continues it where there is one."""
        midway = [sys.executable, "-m", "midway.cli"]
        if RunFolder(folder).config_file.exists():
            return [*midway, "resume", str(folder)]
        arguments = ["--agent", self.agent, "--seed", str(self.seed), "--out", str(folder)]
        return [*midway, "train", self.env, *arguments, *self.options]


@dataclass(frozen=True)
class Status:
    """How far a run is.

    Attributes:
        job: The run.
        state: Whether it waits, runs, is finished or has failed.
        step: Environment steps at its last evaluation.
        success: Its success on the hard task (uniform where there is none), mean actions.
    """

    job: Job
    state: State
    step: int | None
    success: float | None


Execute: TypeAlias = Callable[[Job, Path], bool]
"""Runs a job in its folder, to its end; returns whether it is finished."""


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
        workers = _local_workers(wanted, folder, states)
    else:
        from midway.cluster import on_ray

        workers = on_ray.start(wanted, folder, states, ray_address)
    for worker in workers:
        worker.start()
    while any(worker.is_alive() for worker in workers):
        show(statuses(folder, states))
        time.sleep(POLL_SECONDS)
    final = statuses(folder, states)
    show(final)
    return final


def statuses(folder: Path, states: dict[Job, State]) -> list[Status]:
    """Return the state of every job, with the last line of its evaluations."""
    found = []
    for job, state in dict(states).items():
        step, success = last_success(RunFolder(folder / job.name).evaluation_file)
        found.append(Status(job, state, step, success))
    return found


def last_success(evaluation: Path) -> tuple[int | None, float | None]:
    """Return step and success of the last evaluation: mean actions, ``hard`` if it is there."""
    try:
        with evaluation.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get("actions") == "mean"]
        last = [row for row in rows if row["step"] == rows[-1]["step"]]
        row = next((row for row in last if row["task"] == "hard"), last[0])
        return int(row["step"]), float(row["success_rate"])
    except (OSError, IndexError, TypeError, ValueError):
        return None, None


def finished(job: Job, folder: Path) -> bool:
    """Return whether the run has taken all its steps."""
    run_folder = RunFolder(folder / job.name)
    if not run_folder.config_file.exists():
        return False
    step, _ = last_success(run_folder.evaluation_file)
    return step is not None and step >= run_folder.load_config().train.steps


def execute(job: Job, folder: Path, core: int | None = None) -> bool:
    """Run a job in a process of its own, on one core if given; return whether it is finished.

    The process dies with its parent: a machine's or worker's end must not leave a second writer.
    """
    _wait_until_free(RunFolder(folder / job.name))
    command = ["setpriv", "--pdeathsig", "KILL", *job.command(folder / job.name)]
    if core is not None:
        command = ["taskset", "-c", str(core), *command]
    with (folder / f"{job.name}.log").open("a") as log:
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False)
    return finished(job, folder)


def _wait_until_free(run_folder: RunFolder) -> None:
    """Wait for a process that has lost its worker, and is about to die, to let go of the run."""
    for _ in range(int(RELEASE_SECONDS / POLL_SECONDS)):
        if not run_folder.in_use():
            return
        time.sleep(POLL_SECONDS)


def _local_workers(
    wanted: Sequence[Job], folder: Path, states: dict[Job, State]
) -> list[threading.Thread]:
    """Return one thread for each core; each takes jobs until none is left."""
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in wanted:
        waiting.put(job)

    def work(core: int) -> None:
        while True:
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                return
            states[job] = "running"
            done = finished(job, folder) or execute(job, folder, core)
            states[job] = "finished" if done else "failed"

    cores = sorted(os.sched_getaffinity(0))
    return [threading.Thread(target=work, args=(core,), daemon=True) for core in cores]


def table(found: Sequence[Status]) -> Any:
    """Return a table of all jobs for a terminal."""
    from rich.table import Table

    view = Table("run", "state", "step", "success")
    for status in found:
        step = "" if status.step is None else str(status.step)
        success = "" if status.success is None else f"{status.success:.0%}"
        view.add_row(status.job.name, status.state, step, success)
    return view
