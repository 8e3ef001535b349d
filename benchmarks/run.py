"""Run the experiments behind a figure, one core each, and keep their results as CSV.

    python benchmarks/run.py point-mazes --runs DIR

Started again with the same folder, it resumes what was interrupted and skips what is finished. The
results go to ``benchmarks/results/SUITE/``: for each run ``evaluation.csv``, ``metrics.csv`` and
``config.json``, which holds every value, the commit and the exact command.
"""

import argparse
import shutil
import sys
from pathlib import Path

from rich.console import Console
from rich.live import Live

from midway.cluster import sweep
from midway.cluster.jobs import Job

RESULTS = Path(__file__).parent / "results"
KEPT = ("evaluation.csv", "metrics.csv", "config.json")

POINT_MAZES = ("point-u", "point-s", "point-pi", "point-omega")
ANT_MAZES = ("ant-u", "ant-s", "ant-pi", "ant-omega")
SEEDS = range(5)
F32 = ("--precision", "f32")
BF16 = ("--precision", "bf16")
ROBOTICS = {
    "PandaReach-v3": 20_000,
    "PointMaze_UMaze-v3": 32_000,
    "PointMaze_Medium-v3": 96_000,
    "FetchReach-v4": 12_000,
    "FetchPush-v4": 180_000,
    "PandaPush-v3": 60_000,
}
"""Environment steps on the environments of others; 50 episodes an evaluation take their time."""
WITHOUT = {
    "n-step": ("n_step=1",),
    "goal-inputs": ("goal_inputs=whole", "normalise=False"),
    "unreached-goals": ("unreached_goals=False",),
    "single-critic": ("num_critics=2",),
    "collect-limit": ("collect_limit=0",),
    "layer-norm": ("layer_norm=False",),
}
"""What ``quick`` adds on the ant, and the settings that take it away."""

SUITES: dict[str, list[Job]] = {
    "point-mazes": [
        Job(env, agent, seed, BF16)
        for agent in ("ris", "sac")
        for env in POINT_MAZES
        for seed in SEEDS
    ],
    "point-u-agents": [
        Job("point-u", agent, seed) for agent in ("tdm", "leap", "crl") for seed in range(3)
    ],
    "push-f32": [
        Job("push", "ris", 0, (*F32, "--set", "random_shift=4", "advantage_temperature=0.1"))
    ],
    "precision": [Job("point-u", "ris", seed, F32, "f32") for seed in SEEDS],
    "ant-mazes": [
        *(Job(env, "ris", seed) for seed in range(3) for env in ANT_MAZES),
        *(Job(env, agent, 0) for agent in ("sac", "leap") for env in ANT_MAZES),
        Job("ant-u", "tdm", 0),
    ],
    "arm": [
        *(Job("push", "ris", seed) for seed in range(3)),
        *(Job("push", agent, 0) for agent in ("sac", "leap")),
        *(Job("push-state", agent, seed) for agent in ("ris", "sac") for seed in range(3)),
        Job("push-state", "leap", 0),
    ],
    "ant-u-ablations": [
        Job("ant-u", "ris", 0, ("--set", "steps=128000", *settings), f"without-{name}")
        for name, settings in WITHOUT.items()
    ],
    "ant-u": [Job("ant-u", agent, 0, BF16) for agent in ("ris", "sac", "leap")],
    "robotics": [
        Job(env, agent, seed, ("--set", f"steps={steps}", "evaluation_episodes=50"))
        for env, steps in ROBOTICS.items()
        for agent in ("ris", "sac")
        for seed in range(3)
    ],
}


def main() -> None:
    """Run one suite."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the run folders")
    arguments = parser.parse_args()
    with Live(console=Console(stderr=True), refresh_per_second=1) as live:
        sweep.run(
            SUITES[arguments.suite],
            arguments.runs,
            lambda found: live.update(sweep.table(found)),
        )
    for job in SUITES[arguments.suite]:
        keep(arguments.runs / job.name, RESULTS / arguments.suite / job.name)


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
