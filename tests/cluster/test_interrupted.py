"""A sweep that is interrupted lets its runs write their checkpoints, and goes on from them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from midway.cluster.jobs import Processes
from midway.training.checkpoint import steps_in

LONG = ["hidden=(8,)", "batch_size=8", "num_envs=4", "random_steps=16", "replay_capacity=2000"]
LONG += ["evaluate_every=10_000_000", "log_every=40", "checkpoint_every=10_000_000"]


def start(out: Path) -> "subprocess.Popen[str]":
    """Start a sweep of two runs that would not end by themselves."""
    words = [sys.executable, "-m", "midway.cli", "sweep", "point-u", "--agents", "sac"]
    words += ["--seeds", "0", "1", "--steps", "9_000_000", "--out", str(out), "--set", *LONG]
    return subprocess.Popen(words, stderr=subprocess.PIPE, process_group=0, text=True)


def wait_for(sweep: "subprocess.Popen[str]", condition: Callable[[], bool]) -> None:
    """Wait for something, as long as the sweep runs."""
    while not condition():
        assert sweep.poll() is None
        time.sleep(0.1)


def is_running(process: int) -> bool:
    """Return whether a process has a command line: one that has ended has none."""
    try:
        return bool(Path(f"/proc/{process}/cmdline").read_bytes())
    except OSError:
        return False


def test_an_interrupted_sweep_leaves_checkpoints(tmp_path: Path) -> None:
    sweep = start(tmp_path)
    logs = [tmp_path / f"point-u-sac-seed{seed}.log" for seed in (0, 1)]
    running = logs[: len(os.sched_getaffinity(0))]
    wait_for(sweep, lambda: all(log.exists() and "step " in log.read_text() for log in running))
    os.killpg(sweep.pid, signal.SIGINT)  # as a terminal does
    _, said = sweep.communicate()
    assert sweep.returncode == 130
    assert "type the same command again" in said
    for log in running:
        assert log.read_text().count("interrupted: checkpoint") == 1
        assert steps_in(log.with_suffix("") / "checkpoints")


def test_the_second_signal_kills_the_runs_of_a_sweep(tmp_path: Path) -> None:
    sweep = start(tmp_path)
    task = Path(f"/proc/{sweep.pid}/task")

    def runs() -> list[int]:
        words = " ".join(file.read_text() for file in task.glob("*/children"))
        return [int(word) for word in words.split()]

    wait_for(sweep, lambda: len(runs()) == min(2, len(os.sched_getaffinity(0))))
    held = runs()
    for run in held:
        os.kill(run, signal.SIGSTOP)  # it does not obey the first signal
    for number in (signal.SIGINT, signal.SIGTERM):
        sweep.send_signal(number)
    _, said = sweep.communicate()
    assert sweep.returncode == 130
    assert said.splitlines()[-1] == "midway: interrupted"
    while any(is_running(run) for run in held):  # killed, they take a moment to go
        time.sleep(0.1)


def test_processes_are_asked_once_and_no_other_is_started(tmp_path: Path) -> None:
    processes, log = Processes(), tmp_path / "log"
    processes.end()
    assert processes.run(["true"], log) == 128 + signal.SIGTERM
    assert log.read_text() == ""


@pytest.mark.parametrize("status", [0, 3])
def test_the_status_of_a_process_is_returned(tmp_path: Path, status: int) -> None:
    assert Processes().run(["sh", "-c", f"exit {status}"], tmp_path / "log") == status
