"""Print a table of the results of a suite, one row for each environment and agent.

    python benchmarks/summary.py benchmarks/results/point-mazes

Success is that of the last evaluation: one seed, or the interquartile mean of several, with the
95 % interval, which counts episodes and seeds (``midway.statistics``). Minutes are training time
until an evaluation on the hard task first reached 95 % with the deterministic policy, of the
slowest seed.
"""

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path

from midway.statistics import of_agent

Rows = list[dict[str, str]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", type=Path, help="folder of results")
    groups: dict[tuple[str, str, str], list[Rows]] = defaultdict(list)
    for folder in sorted(parser.parse_args().suite.iterdir()):
        config = json.loads((folder / "config.json").read_text())
        with (folder / "evaluation.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        key = config["env"], config["agent"], config["hyperparameters"]["precision"]
        groups[key].append(rows)
    print(
        "| environment | agent | precision | seeds | steps | hard, mean | hard, sampled | ", end=""
    )
    print("uniform, mean | minutes to 95 % |")
    print("| --- " * 9 + "|")
    for (env, agent, precision), runs in groups.items():
        steps = max(int(rows[-1]["step"]) for rows in runs)
        cells = [env, agent, precision, str(len(runs)), str(steps)]
        for task, actions in (("hard", "mean"), ("hard", "sampled"), ("uniform", "mean")):
            last = [of(rows, task, actions)[-1] for rows in runs]
            rates = [float(row["success_rate"]) for row in last]
            success = of_agent(rates, [int(row["episodes"]) for row in last])
            centre, low, high = (f"{100 * share:.0f}" for share in success)
            cells.append(f"{centre} % [{low}, {high}]")
        print("| " + " | ".join([*cells, minutes(runs)]) + " |")


def of(rows: Rows, task: str, actions: str) -> Rows:
    """Return the evaluations of one task and kind of action."""
    return [row for row in rows if (row["task"], row["actions"]) == (task, actions)]


def minutes(runs: list[Rows]) -> str:
    """Return when the slowest seed reached 95 %, or how many did."""
    reached = []
    for rows in runs:
        good = [row for row in of(rows, "hard", "mean") if float(row["success_rate"]) >= 0.95]
        if good:
            reached.append(float(good[0]["training_seconds"]) / 60)
    if len(reached) < len(runs):
        return f"{len(reached)} of {len(runs)} seeds"
    return f"{max(reached):.1f}"


if __name__ == "__main__":
    main()
