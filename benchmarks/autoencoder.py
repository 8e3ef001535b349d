"""Measure how well LEAP's autoencoder of states keeps positions, as it is set and as published.

    python benchmarks/autoencoder.py [ENV]

Trains it as `midway train ENV --agent leap` does, before anything else is learned: about a minute
for each setting. Writes ``benchmarks/results/autoencoder/ENV.csv``.
"""

import argparse
import csv
import tempfile
from pathlib import Path
from typing import Any

from midway.training.folder import RunFolder

from midway.training import api
from midway.training.progress import Silent

RESULTS = Path(__file__).parent / "results" / "autoencoder"
WEIGHTS = (1e-4, 1e-2)
"""Of the KL divergence: ours for the ant, and the original's (5e-3 of twice the divergence)."""
RANDOM_ACTIONS = (0, 1)
"""After each reset: ours, and the original's."""


def main() -> None:
    """Measure one environment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env", nargs="?", default="ant-u")
    env = parser.parse_args().env
    rows = [measure(env, weight, actions) for actions in RANDOM_ACTIONS for weight in WEIGHTS]
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / f"{env}.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


def measure(env: str, weight: float, random_actions: int) -> dict[str, Any]:
    """Return the errors of states that were held out, after the last round."""
    changes = {"vae_kl_weight": weight, "vae_random_actions": random_actions}
    config = api.configure(env, "leap", changes=changes)
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder(Path(name))
        api.build(config, folder).pretrain(Silent())
        with (folder.path / "pretraining.csv").open() as file:
            last = list(csv.DictReader(file))[-1]
    found = {
        **changes,
        "rounds": int(last["step"]),
        "held_out_distance": float(last["vae/held_out_distance"]),
        "kl": float(last["vae/kl"]),
    }
    print(env, *found.items())
    return found


if __name__ == "__main__":
    main()
