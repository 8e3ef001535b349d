"""Measure how often uniform random actions reach the goal: what a policy has to beat.

    python benchmarks/random_policy.py ENV... [--episodes N]

Writes ``benchmarks/results/random-policy/ENV.csv``, one row for each of ``hard`` and ``uniform``.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np

import midway
from midway.training.evaluate import run_episodes

RESULTS = Path(__file__).parent / "results" / "random-policy"
SEED = 0


def main() -> None:
    """Measure the environments that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environments", nargs="+", metavar="ENV")
    parser.add_argument("--episodes", type=int, default=200)
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name in arguments.environments:
        rows = [measure(name, task, arguments.episodes) for task in ("hard", "uniform")]
        with (RESULTS / f"{name}.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, rows[0])
            table.writeheader()
            table.writerows(rows)
        for row in rows:
            print(name, *row.values())


def measure(name: str, task: str, episodes: int) -> dict[str, Any]:
    """Return success rate and mean final distance (m) of random actions."""
    env = midway.make_vec(name, num_envs=episodes, task=task)
    generator = np.random.default_rng(SEED)

    def act(observation: Any, goal: Any) -> Any:
        return generator.uniform(-1, 1, env.action_space.shape).astype(np.float32)

    found = run_episodes(env, act, task, "sampled", SEED)
    return {
        "task": task,
        "episodes": episodes,
        "success_rate": found.success_rate,
        "final_distance": found.final_distance,
    }


if __name__ == "__main__":
    main()
