"""Measure how well LEAP's autoencoder keeps the states of an environment.

    python benchmarks/autoencoder.py quick [ENV ...]
    python benchmarks/autoencoder.py paper [ENV ...]
    python benchmarks/autoencoder.py weights ant-u

Trains it as `midway train ENV --agent leap` does, before anything else is learned. The first two
measure a preset as it is, in all environments if none is named, and write
``benchmarks/results/autoencoder/PRESET.csv``; the last compares weights of the KL divergence and
random actions, ours and the original's, and writes ``benchmarks/results/autoencoder/ENV.csv``.
"""

import argparse
import csv
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from midway import api
from midway.envs.registry import ENVIRONMENTS
from midway.runs.folder import RunFolder
from midway.training import state as states

RESULTS = Path(__file__).parent / "results" / "autoencoder"
WEIGHTS = (1e-4, 1e-2)
"""Of the KL divergence: ours for the ant, and the original's (5e-3 of twice the divergence)."""
RANDOM_ACTIONS = (0, 1)
"""After each reset: ours, and the original's."""
ROUNDS = (10, 20, 30, 50, 100, 200, 300, 600, 1_200, 2_500)
"""Rounds of a preset after which the errors are written down."""

Row = dict[str, object]


def main() -> None:
    """Measure presets, or settings of one environment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=("quick", "paper", "weights"))
    parser.add_argument("envs", nargs="*")
    arguments = parser.parse_args()
    if arguments.table == "weights":
        for env in arguments.envs or ["ant-u"]:
            write(RESULTS / f"{env}.csv", compare(env))
        return
    file = RESULTS / f"{arguments.table}.csv"
    for env in arguments.envs or ENVIRONMENTS:
        rows = [{"env": env, **row} for row in measure(env, arguments.table, {})]
        before = list(csv.DictReader(file.open())) if file.exists() else []
        write(file, [*(row for row in before if row["env"] != env), *rows])


def compare(env: str) -> list[Row]:
    """Return the errors after the last round of `quick`, by weight and random actions."""
    rows = []
    for actions in RANDOM_ACTIONS:
        for weight in WEIGHTS:
            changes = {"vae_kl_weight": weight, "vae_random_actions": actions}
            rows.append({**changes, **measure(env, "quick", changes)[-1]})
    return rows


def measure(env: str, preset: str, changes: Mapping[str, object]) -> list[Row]:
    """Return the errors of states that were held out, after some of the rounds and the last."""
    config = api.configure(env, "leap", preset, changes=changes)
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder(Path(name))
        states.start(api.setup_of(config, folder), print)
        with (folder.path / "pretraining.csv").open() as file:
            rounds = list(csv.DictReader(file))
    kept = [row for row in rounds[:-1] if int(row["step"]) in ROUNDS] + rounds[-1:]
    return [
        {
            "rounds": int(row["step"]),
            "held_out_distance": row.get("vae/held_out_distance", ""),
            "held_out_error": row["vae/held_out_error"],
            "kl": row["vae/kl"],
        }
        for row in kept
    ]


def write(file: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as opened:
        table = csv.DictWriter(opened, rows[0])
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
