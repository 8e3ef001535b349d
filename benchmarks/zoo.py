"""Put trained policies into the zoo, each with what it reaches in 500 episodes and a video.

    python benchmarks/zoo.py [RUN...]

Each becomes ``zoo/ENV-AGENT`` with the best policy of the run, or the last where none was confirmed
as the best: a run folder without checkpoints, which ``midway evaluate``, ``watch``, ``report`` and
``midway.load("zoo:ENV-AGENT")`` read like any other. Its card is ``README.md``; the table of all of
them, ``zoo/README.md``, is written anew each time.
"""

import argparse
import itertools
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

from midway import api, reports
from midway.runs import kept
from midway.runs.folder import ZOO, RunFolder, read_json, write_json
from midway.statistics import of_policy
from midway.training.arrays import said_of
from midway.training.evaluate import ActionKind

KEPT = ("config.json", "metrics.csv", "evaluation.csv")
EPISODES = 500
SEED = 1_000
"""Of starts and goals: training evaluates on others."""

TASKS = ("hard", "uniform")
ACTIONS: tuple[ActionKind, ...] = ("mean", "sampled")


class Row(TypedDict):
    """What a policy reaches in a task with a kind of actions: an entry of ``evaluation.json``."""

    task: str
    actions: ActionKind
    episodes: int
    seed: int
    success_rate: float
    interval: list[float]
    steps: float
    final_distance: float


def main() -> None:
    """Add the policies of some run folders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="*", help="run folders; without any: the table")
    for run in parser.parse_args().runs:
        print(add(RunFolder(run)))
    (ZOO / "README.md").write_text(table(sorted(path.parent for path in ZOO.glob("*/policy.json"))))


def add(run: RunFolder) -> Path:
    """Copy the policy of a run, measure it, film it and write its card."""
    config = run.load_config()
    folder = ZOO / f"{config.env}-{config.agent}"
    folder.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copy(run.path / name, folder / name)
    shown = RunFolder(folder)
    weights = kept.weights_of(run, "best" if kept.best(run) else "last")
    shutil.copy(weights, shown.policy_weights)
    step = said_of(weights)["step"]
    write_json(shown.policy_config, {**read_json(run.policy_config), "step": step})
    known = config.declaration().tasks
    tasks = [task for task in TASKS if task in known]
    found = [measure(folder, task, actions) for task in tasks for actions in ACTIONS]
    (folder / "evaluation.json").write_text(json.dumps(found, indent=2) + "\n")
    reports.watch(folder, folder / f"{tasks[0]}.mp4", task=tasks[0])
    (folder / "README.md").write_text(card(shown, found))
    return folder


def measure(folder: Path, task: str, actions: ActionKind) -> Row:
    """Return what the policy reaches in a task."""
    result = api.evaluate(folder, episodes=EPISODES, task=task, actions=actions, seed=SEED)
    estimate = of_policy(result.success_rate, EPISODES)
    return {
        "task": task,
        "actions": actions,
        "episodes": EPISODES,
        "seed": SEED,
        "success_rate": round(estimate.centre, 4),
        "interval": [round(estimate.low, 4), round(estimate.high, 4)],
        "steps": round(result.length, 1),
        "final_distance": round(result.final_distance, 4),
    }


def card(folder: RunFolder, found: Sequence[Row]) -> str:
    """Return what there is to know of the policy, as Markdown."""
    config, record = folder.load_config(), read_json(folder.config_file)
    rows = "\n".join(
        f"| `{row['task']}` | {row['actions']} | {row['success_rate']:.1%} | "
        f"{row['interval'][0]:.1%} to {row['interval'][1]:.1%} | {row['steps']} | "
        f"{row['final_distance']:.2f} m |"
        for row in found
    )
    name, task = folder.path.name, found[0]["task"]
    who = f"{config.agent.upper()} on `{config.env}`, preset `{config.preset}`, seed {config.seed}"
    again = f"midway evaluate zoo:{name} --task {task} --episodes {EPISODES} --seed {SEED}"
    return f"""# {name}

{who}: the policy of step {read_json(folder.policy_config)["step"]:,}.

| task | actions | success | interval (Wilson, 95 %) | steps | distance at the end |
| --- | --- | --- | --- | --- | --- |
{rows}

{EPISODES} episodes each (`evaluation.json`; `{again}`).
One seed of training shows what can happen. Video: `{task}.mp4`.

Trained by `{record["command"]}` at commit `{record["commit"]}`.

```python
import midway

policy = midway.load("zoo:{name}")
```
"""


def table(folders: Sequence[Path]) -> str:
    """Return what all policies reach, as Markdown."""
    lines = []
    for folder in folders:
        found: list[Row] = json.loads((folder / "evaluation.json").read_text())
        step = read_json(RunFolder(folder).policy_config)["step"]
        rates = [reached(found, *column) for column in itertools.product(TASKS, ACTIONS)]
        link = f"[{folder.name}]({folder.name}/README.md)"
        lines.append(" | ".join(["", link, f"{step:,}", *rates, ""]).strip())
    rows = "\n".join(lines)
    return f"""# Trained policies

Each is `midway.load("zoo:NAME")`, `midway evaluate zoo:NAME` and `midway watch zoo:NAME`; its card
says how it was trained. Success (%) of {EPISODES} episodes, with the deterministic policy and with
sampled actions; 95 % intervals (Wilson; `evaluation.json`). One seed of training each: what can
happen, not what will.

| policy | step | `hard` | `hard`, sampled | `uniform` | `uniform`, sampled |
| --- | --- | --- | --- | --- | --- |
{rows}

The table is that of `python benchmarks/zoo.py`, which adds policies of run folders too.
"""


def reached(found: Sequence[Row], task: str, actions: ActionKind) -> str:
    """Return the success in a task with its interval; a dash where it was not measured."""
    for row in found:
        if (row["task"], row["actions"]) == (task, actions):
            low, high = row["interval"]
            return f"{100 * row['success_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
    return "-"


if __name__ == "__main__":
    main()
