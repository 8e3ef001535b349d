"""One run of a sweep: its command, its folder, and how far it is."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from midway import tables
from midway.errors import ConfigurationError
from midway.runs import complete
from midway.runs.folder import RunFolder, run_name
from midway.settings import changed, split
from midway.statistics import Estimate, of_policy

State: TypeAlias = Literal["waiting", "running", "finished", "failed", "stopped"]

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
        agent = f"{self.agent}-{self.label}" if self.label else self.agent
        return run_name(self.env, agent, self.seed)

    def command(self, folder: Path) -> list[str]:
        """Return the command that starts the run, or continues it where there is one."""
        midway = [sys.executable, "-m", "midway.cli"]
        if RunFolder(folder).config_file.exists():
            steps = [] if self.steps is None else ["--steps", str(self.steps)]
            return [*midway, "resume", str(folder), *steps]
        arguments = ["--agent", self.agent, "--seed", str(self.seed), "--out", str(folder)]
        return [*midway, "train", self.env, *arguments, *self.options]

    @property
    def steps(self) -> int | None:
        """Environment steps that its options ask for; None for the preset's."""
        given = [o.partition("=")[2] for o in self.options if o.startswith("steps=")]
        return int(given[-1]) if given else None


Execute: TypeAlias = Callable[[Job, Path, Callable[[], bool]], State]
"""Runs a job of a folder to its end, or until it is told to stop; returns how it ended."""


class Processes:
    """The processes of the runs that are going on, which can be ended together."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self.ending = threading.Event()

    def run(
        self, command: Sequence[str], log: Path, stop: Callable[[], bool] = lambda: False
    ) -> int:
        """Run a command, what it says in a file; return its status.

        Where ``stop`` is true, which is asked every second, it ends with a checkpoint.

        It is in a group of its own: a terminal's Ctrl-C reaches it through `end` alone, once.
        """
        with log.open("a") as file:
            streams: Any = {"stdin": subprocess.DEVNULL, "stdout": file}
            with self._lock:
                if self.ending.is_set():
                    return 128 + signal.SIGTERM
                process = subprocess.Popen(
                    command, **streams, stderr=subprocess.STDOUT, process_group=0
                )
                self._running.add(process)
            status = _wait(process, stop)
        with self._lock:
            self._running.discard(process)
        return status

    def end(self) -> None:
        """Let each process write its checkpoint and end, and start no other."""
        with self._lock:
            self.ending.set()
            for process in self._running:
                process.terminate()

    def kill(self) -> None:
        """End each process at once."""
        with self._lock:
            for process in self._running:
                process.kill()


def _wait(process: subprocess.Popen[bytes], stop: Callable[[], bool]) -> int:
    """Wait for a process, which is told once to end where ``stop`` is true."""
    while process.poll() is None:
        try:
            return process.wait(POLL_SECONDS)
        except subprocess.TimeoutExpired:
            if stop():
                process.terminate()
                return process.wait()
    return process.wait()


def execute(
    job: Job,
    folder: Path,
    core: int | None = None,
    processes: Processes | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> State:
    """Run a job in a process of its own, on one core if given; return how it ended.

    The process dies with its parent: a machine's or worker's end must not leave a second writer.
    """
    processes = processes or Processes()
    _wait_until_free(RunFolder(folder / job.name), processes.ending)
    command = ["setpriv", "--pdeathsig", "KILL", *job.command(folder / job.name)]
    if core is not None:
        command = ["taskset", "-c", str(core), *command]
    status = processes.run(command, folder / f"{job.name}.log", stop)
    if status == 0 and finished(job, folder):
        return "finished"
    return "stopped" if processes.ending.is_set() else "failed"


def _wait_until_free(run_folder: RunFolder, ending: threading.Event) -> None:
    """Wait for a process that has lost its worker, and is about to die, to let go of the run."""
    for _ in range(int(RELEASE_SECONDS / POLL_SECONDS)):
        if not run_folder.in_use() or ending.wait(POLL_SECONDS):
            return


def finished(job: Job, folder: Path) -> bool:
    """Return whether everything of the run's last step is there."""
    run_folder = RunFolder(folder / job.name)
    try:
        steps = job.steps or run_folder.load_config().train.steps
        return not complete.missing(run_folder, steps)
    except ConfigurationError:  # the run says what is wrong, if there is one
        return False


def check_settings(job: Job, folder: Path, preset: str, changes: Mapping[str, object]) -> None:
    """Check that a run which is there already has the settings that are wanted now.

    Raises:
        ConfigurationError: It has not, but for the number of its steps.
    """
    run_folder = RunFolder(folder / job.name)
    if not run_folder.config_file.exists():
        return
    config = run_folder.load_config()
    if config.preset != preset:
        raise ConfigurationError(
            f"{run_folder.path} has preset {config.preset}, not {preset}: choose another --out"
        )
    known = [config.train, config.hyperparameters]
    for part, given in zip(known, split(changes, known), strict=True):
        wanted = changed(part, {k: v for k, v in given.items() if k != "steps"})
        for name in (name for name in given if name != "steps"):
            if (there := getattr(part, name)) != (new := getattr(wanted, name)):
                raise ConfigurationError(
                    f"{run_folder.path} has {name} {there}, not {new}: choose another --out"
                )


def last_line(folder: Path, job: Job) -> str:
    """Return the last line that a run has said; nothing if it has said none."""
    try:
        lines = (folder / f"{job.name}.log").read_text(errors="replace").split("\n")
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def last_success(evaluation: Path) -> tuple[int | None, Estimate | None]:
    """Return step and success of the last evaluation: mean actions, ``hard`` if it is there."""
    try:
        table = tables.read(evaluation)
        last = (table["actions"] == "mean") & (table["step"] == table["step"].max())
        hard = last & (table["task"] == "hard")
        row = np.flatnonzero(hard if hard.any() else last)[0]
        success = of_policy(table["success_rate"][row], table["episodes"][row])
        return int(table["step"][row]), success
    except (ConfigurationError, KeyError, IndexError, ValueError, OverflowError):
        return None, None
