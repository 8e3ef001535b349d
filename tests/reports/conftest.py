"""Run folders to draw: two tiny ones that are trained once, copies of them, and untrained arms."""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from untrained import save_untrained

from midway import api
from midway.reports import cache, decoder
from midway.runs.folder import RunFolder, write_json

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


UNTRAINED = {"hidden": (8,), "num_envs": 1, "replay_capacity": 400, "random_steps": 10}
EVALUATED = (
    "step,updates,seconds,training_seconds,task,actions,episodes,success_rate,final_distance"
)
EVALUATED += ",episode_length,final_distance_hand,final_distance_puck"


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that trains an agent once for all workers, and copies its run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "trained"

    def train(agent: str) -> Path:
        folder.mkdir(exist_ok=True)
        with FileLock(folder / f"{agent}.lock"):
            if not (run := folder / agent).exists():
                unfinished = folder / f"{agent}.unfinished"
                api.train("point-u", agent=agent, steps=1_200, out=unfinished, changes=TINY)
                unfinished.rename(run)
        return shutil.copytree(run, tmp_path_factory.mktemp("runs") / agent)

    return train


@pytest.fixture(scope="session", autouse=True)
def few_episodes() -> Iterator[None]:
    """Record 20 uniform episodes in a maze instead of 200."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "STEPS", 1)
        yield


@pytest.fixture(scope="session")
def ris_run(trained: Callable[[str], Path]) -> Path:
    return trained("ris")


@pytest.fixture(scope="session")
def sac_run(trained: Callable[[str], Path]) -> Path:
    return trained("sac")


@pytest.fixture
def copy_run(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that copies a run under another seed, cut off after some step."""

    def copy(run: Path, name: str, seed: int = 0, until: int | None = None) -> Path:
        folder = shutil.copytree(run, tmp_path / name, ignore=shutil.ignore_patterns("figures"))
        for file in (folder / "config.json", folder / "policy.json"):
            write_json(file, {**json.loads(file.read_text()), "seed": seed})
        for table in ("metrics.csv", "evaluation.csv"):
            header, *rows = (folder / table).read_text().splitlines()
            kept = [row for row in rows if until is None or int(row.split(",")[0]) <= until]
            (folder / table).write_text("\n".join([header, *kept]) + "\n")
        return folder

    return copy


def untrained(path: Path, env: str, agent: str, changes: Mapping[str, Any] | None = None) -> Path:
    """Return a run folder of an agent that has learned nothing, with two evaluations."""
    folder = RunFolder(path)
    config = api.configure(env, agent, changes={**UNTRAINED, **(changes or {})})
    save_untrained(folder, config, 200)
    rows = [EVALUATED]
    for step in (100, 200):
        for task in ("hard", "uniform"):
            rows += [
                f"{step},0,1,1,{task},{actions},4,0.5,0.3,90,0.1,0.3"
                for actions in ("mean", "sampled")
            ]
    folder.evaluation_file.write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="session")
def state_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("runs") / "state", "push-state", "ris")


@pytest.fixture(scope="session")
def image_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("runs") / "image", "push", "ris")


@pytest.fixture
def quick_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"IMAGES": 40, "NUM_ENVS": 5, "UPDATES": 2, "UPDATES_PER_CALL": 2}.items():
        monkeypatch.setattr(decoder, name, value)


@pytest.fixture(scope="session")
def leap_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of an agent that plans, whose autoencoder and plans take no time."""
    plans = {"num_subgoals": 3, "plan_samples": 16, "plan_iterations": 2}
    small = {**plans, "vae_states": 200, "vae_rounds": 1, "vae_updates": 2}
    return untrained(tmp_path_factory.mktemp("runs") / "leap", "point-u", "leap", small)
