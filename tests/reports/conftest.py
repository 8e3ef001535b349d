"""Run folders to draw: two tiny ones that are trained once, and copies of them."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from midway.training import api

TINY = {
    "num_envs": 8,
    "random_steps": 200,
    "updates_per_step": 0.125,
    "batch_size": 32,
    "hidden": (16, 16),
    "replay_capacity": 4_000,
    "evaluate_every": 400,
    "evaluation_episodes": 4,
    "log_every": 200,
    "checkpoint_every": 1_200,
}


def train(out: Path, agent: str) -> Path:
    return api.train("point-u", agent=agent, steps=1_200, out=out, changes=TINY).path


@pytest.fixture(scope="session")
def ris_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("runs") / "ris", "ris")


@pytest.fixture(scope="session")
def sac_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("runs") / "sac", "sac")


@pytest.fixture
def copy_run(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that copies a run under another seed, cut off after some step."""

    def copy(run: Path, name: str, seed: int = 0, until: int | None = None) -> Path:
        folder = shutil.copytree(run, tmp_path / name, ignore=shutil.ignore_patterns("figures"))
        for file in (folder / "config.json", folder / "policy.json"):
            file.write_text(json.dumps({**json.loads(file.read_text()), "seed": seed}))
        for table in ("metrics.csv", "evaluation.csv"):
            header, *rows = (folder / table).read_text().splitlines()
            kept = [row for row in rows if until is None or int(row.split(",")[0]) <= until]
            (folder / table).write_text("\n".join([header, *kept]) + "\n")
        return folder

    return copy
