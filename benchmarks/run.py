"""Run the experiments behind a figure, one core each, and keep their results as CSV.

    python benchmarks/run.py point-mazes --runs DIR [--cores 0,1]

Started again with the same folder, it resumes what was interrupted and skips what is finished. The
results go to ``benchmarks/results/SUITE/``: for each run ``evaluation.csv``, ``metrics.csv`` and
``config.json``, which holds the exact command and commit.
"""

import argparse
import os
import queue
import shutil
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
KEPT = ("evaluation.csv", "metrics.csv", "config.json")


@dataclass(frozen=True)
class Experiment:
    """One run: the arguments of ``midway train``."""

    env: str
    agent: str
    seed: int
    settings: tuple[str, ...] = ()
    label: str = ""

    @property
    def name(self) -> str:
        """Name of its folder."""
        label = f"-{self.label}" if self.label else ""
        return f"{self.env}-{self.agent}{label}-seed{self.seed}"

    def command(self, folder: Path) -> list[str]:
        """Return the command that starts or continues it."""
        midway = [sys.executable, "-m", "midway.cli"]
        if any((folder / "checkpoints").glob("[0-9]*")):
            return [*midway, "resume", str(folder)]
        shutil.rmtree(folder, ignore_errors=True)
        arguments = ["--agent", self.agent, "--seed", str(self.seed), "--out", str(folder)]
        return [*midway, "train", self.env, *arguments, *self.settings]


POINT_MAZES = ("point-u", "point-s", "point-pi", "point-omega")
SEEDS = range(5)
F32 = ("--precision", "f32")
BF16 = ("--precision", "bf16")
SUITES: dict[str, list[Experiment]] = {
    "point-mazes": [
        Experiment(env, agent, seed, BF16)
        for agent in ("ris", "sac")
        for env in POINT_MAZES
        for seed in SEEDS
    ],
    "precision": [Experiment("point-u", "ris", seed, F32, "f32") for seed in SEEDS],
    "ant-u": [
        Experiment("ant-u", agent, 0, (*BF16, "--steps", "1000000")) for agent in ("ris", "sac")
    ],
}


def main() -> None:
    """Run one suite."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the run folders")
    cores = sorted(os.sched_getaffinity(0))
    parser.add_argument("--cores", default=",".join(map(str, cores)), help="one run on each")
    arguments = parser.parse_args()
    arguments.runs.mkdir(parents=True, exist_ok=True)
    waiting: queue.SimpleQueue[Experiment] = queue.SimpleQueue()
    for experiment in SUITES[arguments.suite]:
        waiting.put(experiment)
    workers = [
        threading.Thread(target=work, args=(waiting, arguments.runs, int(core)))
        for core in arguments.cores.split(",")
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for experiment in SUITES[arguments.suite]:
        keep(arguments.runs / experiment.name, RESULTS / arguments.suite / experiment.name)


def work(waiting: "queue.SimpleQueue[Experiment]", runs: Path, core: int) -> None:
    """Run experiments on one core until none is left."""
    while True:
        try:
            experiment = waiting.get_nowait()
        except queue.Empty:
            return
        folder = runs / experiment.name
        with (runs / f"{experiment.name}.log").open("a") as log:
            subprocess.run(
                ["taskset", "-c", str(core), *experiment.command(folder)],
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            )
        keep(folder, runs / "results" / experiment.name)


def keep(folder: Path, destination: Path) -> None:
    """Copy the numbers of a run."""
    if not (folder / KEPT[0]).exists():
        print(f"no results in {folder}", file=sys.stderr)
        return
    destination.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copy(folder / name, destination / name)


if __name__ == "__main__":
    main()
