"""Print one table of the results of suites, a row for each environment, agent and variant of it.

    python benchmarks/summary.py benchmarks/results/point-mazes
    python benchmarks/summary.py benchmarks/results/ant-u-fast benchmarks/results/ant-mazes

Success is that of the last evaluation of each seed: of one, or the interquartile mean of several,
with the 95 % interval, which counts episodes and seeds (``midway.statistics``). Steps and minutes
of training until an evaluation of the hard task (uniform, where there is none) first reached 95 %
with the deterministic policy are those of the slowest seed.
"""

import argparse
import csv
import json
from collections import defaultdict
from itertools import chain
from pathlib import Path

from midway.statistics import of_agent

Rows = list[dict[str, str]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suites", type=Path, nargs="+", help="folders of results")
    groups: dict[tuple[str, str, str], list[Rows]] = defaultdict(list)
    suites: list[Path] = parser.parse_args().suites
    for folder in chain.from_iterable(sorted(suite.iterdir()) for suite in suites):
        config = json.loads((folder / "config.json").read_text())
        with (folder / "evaluation.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        name = folder.name.removeprefix(config["env"] + "-").rpartition("-seed")[0]
        key = config["env"], name, config["hyperparameters"]["precision"]
        groups[key].append(rows)
    columns = [("hard", "mean"), ("hard", "sampled"), ("uniform", "mean")]
    columns = [
        column
        for column in columns
        if any(of(rows, *column) for rows in next(iter(groups.values())))
    ]
    shown = columns[0][0]
    titles = ["environment", "agent", "precision", "seeds", "steps"]
    titles += [f"{task}, {actions}" for task, actions in columns]
    titles += [f"steps to 95 % of {shown}", "minutes"]
    print("| " + " | ".join(titles) + " |")
    print("| --- " * len(titles) + "|")
    for (env, agent, precision), runs in groups.items():
        steps = sorted({int(rows[-1]["step"]) for rows in runs})
        ends = " to ".join(f"{step:,}" for step in dict.fromkeys((steps[0], steps[-1])))
        cells = [env, agent, precision, str(len(runs)), ends]
        cells += [success(runs, *column) for column in columns]
        print("| " + " | ".join([*cells, *reached(runs, shown)]) + " |")


def success(runs: list[Rows], task: str, actions: str) -> str:
    """Return the success of the last evaluation of all seeds, with its interval."""
    last = [rows[-1] for run in runs if (rows := of(run, task, actions))]
    if not last:
        return ""
    rates = [float(row["success_rate"]) for row in last]
    centre, low, high = of_agent(rates, [int(row["episodes"]) for row in last])
    return f"{100 * centre:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def of(rows: Rows, task: str, actions: str) -> Rows:
    """Return the evaluations of one task and kind of action."""
    return [row for row in rows if (row["task"], row["actions"]) == (task, actions)]


def reached(runs: list[Rows], task: str) -> tuple[str, str]:
    """Return when the slowest seed reached 95 % (steps, minutes of training), or how many did."""
    good = [
        [row for row in of(run, task, "mean") if float(row["success_rate"]) >= 0.95] for run in runs
    ]
    first = [rows[0] for rows in good if rows]
    if len(first) < len(runs):
        return f"{len(first)} of {len(runs)} seeds", ""
    steps = max(int(row["step"]) for row in first)
    return f"{steps:,}", f"{max(float(row['training_seconds']) for row in first) / 60:.1f}"


if __name__ == "__main__":
    main()
