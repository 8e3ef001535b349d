"""Evaluate the policies that runs kept on their way, and the last, on many episodes each.

    python benchmarks/snapshots.py RUN [RUN ...] --episodes 100 --from-step 100000

writes ``snapshots.csv`` beside the numbers of the run in ``--out``. The episodes are others than
those of the evaluations during training.
"""

import argparse
import csv
from pathlib import Path

from midway.reports.runs import read
from midway.runs import policy as policies
from midway.training.evaluate import run_episodes

SEED = 1_000_000
"""Of starts and goals; training evaluates on small seeds."""


def main() -> None:
    """Evaluate each policy of each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--task", default="hard")
    parser.add_argument("--from-step", type=int, default=0, help="leave earlier policies out")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs' numbers")
    arguments = parser.parse_args()
    for run in map(read, arguments.runs):
        env = run.config.declaration().factory(arguments.episodes, arguments.task)
        rows = []
        for step, weights in {
            **run.past_weights,
            run.policy_step: run.folder.policy_weights,
        }.items():
            if step < arguments.from_step:
                continue
            policy = policies.load(run.folder, weights)
            found = run_episodes(env, policy.actor(), arguments.task, "mean", SEED)
            row = (step, arguments.task, "mean", arguments.episodes, found.success_rate)
            rows.append((*row, round(found.final_distance, 4), round(found.length, 1)))
            print(run.folder.path.name, *rows[-1], flush=True)
        folder = arguments.out / run.folder.path.name
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "snapshots.csv").open("w", newline="") as file:
            names = ("step", "task", "actions", "episodes", "success_rate", "final_distance")
            csv.writer(file).writerows([(*names, "episode_length"), *rows])


if __name__ == "__main__":
    main()
