"""Train two runs for hours and see what grows: memory, open files, threads, processes.

    python benchmarks/soak.py --runs DIR [--hours 2] [--every 30]
    python benchmarks/soak.py --read CSV...

The first command trains both with small replays, which are full within minutes, with many
evaluations and checkpoints, and ends them by SIGTERM. It writes one CSV file for each run as it
goes. The second prints, for what a run's processes hold together, the level after the warm-up and
the slope per hour (Theil-Sen) with its 95% interval. Needs `psutil`.
"""

import argparse
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
from scipy.stats import theilslopes

from midway import tables

RESULTS = Path(__file__).parent / "results" / "soak"
SMALL = ("hidden=(64, 64)", "batch_size=64", "log_every=500", "evaluation_episodes=4")
OFTEN = ("evaluate_every=4000", "checkpoint_every=4000", "replay_capacity=10000")
RUNS = ("point-u", "PandaReach-v3")
"""The second one's environments are stepped by processes of their own, on two cores or more."""
QUANTITIES = ("resident_mb", "descriptors", "threads", "processes")
WARM_UP = 0.2
"""Share of the samples before the slope: programs are compiled, and the replay fills."""
PATIENCE = 120.0
"""Seconds that a run may take to end."""


def main() -> None:
    """Run the soak, or read what one has written."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, help="folder of the runs, which must not be there")
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--every", type=float, default=30.0, help="seconds between samples")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--read", type=Path, nargs="+", help="print the slopes of these files")
    arguments = parser.parse_args()
    if arguments.read:
        for path in arguments.read:
            print_slopes(path)
    else:
        soak(arguments.runs, arguments.hours * 3600, arguments.every, arguments.results)


def soak(folder: Path, seconds: float, every: float, results: Path) -> None:
    """Train the runs for this long, and write what their processes hold.

    Raises:
        SystemExit: A run did not end by the signal alone.
    """
    folder.mkdir(parents=True)
    results.mkdir(parents=True, exist_ok=True)
    for env in RUNS:  # the rows of an earlier soak
        (results / f"{env}.csv").unlink(missing_ok=True)
    files = {env: tables.Appender(results / f"{env}.csv", until=-1) for env in RUNS}
    started = time.monotonic()
    running = {env: start(env, folder) for env in RUNS}
    while (passed := time.monotonic() - started) < seconds and not ended(running):
        for env, process in running.items():
            files[env].write(sample(process, folder / env, passed))
        time.sleep(every)
    for process in running.values():
        process.send_signal(signal.SIGTERM)
    statuses = {env: process.wait(PATIENCE) for env, process in running.items()}
    for env, status in statuses.items():
        files[env].write({"seconds": round(time.monotonic() - started), "status": status})
        print_slopes(results / f"{env}.csv")
    if set(statuses.values()) != {128 + signal.SIGTERM}:
        raise SystemExit(f"not all runs ended by the signal alone: {statuses}")


def start(env: str, folder: Path) -> "subprocess.Popen[bytes]":
    """Start a run that would not end by itself."""
    command = [sys.executable, "-m", "midway.cli", "train", env, "--agent", "ris"]
    settings = ["--steps", "1000000000", "--set", *SMALL, *OFTEN]
    with (folder / f"{env}.log").open("wb") as log:
        return subprocess.Popen(
            [*command, "--out", str(folder / env), *settings], stdout=log, stderr=log
        )


def ended(running: "dict[str, subprocess.Popen[bytes]]") -> bool:
    """Return whether a run has ended."""
    return any(process.poll() is not None for process in running.values())


def sample(
    process: "subprocess.Popen[bytes]", run: Path, seconds: float
) -> dict[str, float | int | str]:
    """Return one row: what the run and all processes below it hold."""
    main = psutil.Process(process.pid)
    held = [of_process(each) for each in (main, *main.children(recursive=True))]
    resident, descriptors, threads = (sum(column) for column in zip(*held, strict=True))
    reached = tables.read(run / "metrics.csv").get("step")
    return {
        "seconds": round(seconds),
        "step": 0 if reached is None else int(reached[-1]),
        "resident_mb": round(resident / 1e6, 1),
        "descriptors": descriptors,
        "threads": threads,
        "processes": len(held),
        "status": "",
    }


def of_process(process: psutil.Process) -> tuple[int, int, int]:
    """Return resident bytes, open descriptors and threads; nothing of one that has just ended."""
    try:
        with process.oneshot():
            return process.memory_info().rss, process.num_fds(), process.num_threads()
    except psutil.Error:
        return 0, 0, 0


def print_slopes(path: Path) -> None:
    """Print how a run ended, and a line for each quantity."""
    table = tables.read(path)
    sampled = table["processes"] > 0
    first = round(WARM_UP * sampled.sum())
    hours = table["seconds"][sampled][first:] / 3600
    steps = table["step"][sampled]
    print(
        f"{path.stem}: {table['seconds'].max() / 3600:.2f} h, {steps.max():.0f} steps, "
        f"status {table['status'][-1]:.0f}; after the first {hours[0] * 60:.0f} min:"
    )
    for quantity in QUANTITIES:
        values = table[quantity][sampled][first:]
        slope, _, low, high = theilslopes(values, hours)
        level = f"{values[0]:g} to {values[-1]:g}, at most {values.max():g}"
        print(f"  {quantity:<12} {level}; {slope:+.3g} per hour ({low:+.3g} to {high:+.3g})")


if __name__ == "__main__":
    main()
