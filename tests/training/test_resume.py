"""Stopped and resumed runs equal those that were never stopped."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import midway
import short
from midway import api
from midway.errors import ConfigurationError, NonFiniteError
from midway.runs.folder import RunFolder
from midway.runs.policy import load
from midway.training import loop, state
from midway.training.checkpoint import Checkpoints
from midway.training.state import Training

SMALL = {
    "hidden": (8, 8),
    "batch_size": 16,
    "num_envs": 4,
    "random_steps": 40,
    "updates_per_step": 0.75,
    "replay_capacity": 2_000,
    "evaluate_every": 200,
    "evaluation_episodes": 2,
    "log_every": 60,
    "checkpoint_every": 100,
    "steps": 400,
    "policy_average_rate": 0.1,
}
SNAPSHOTS = (52, 100, 152, 200, 252, 300, 352, 400)
TIMES = ("seconds", "training_seconds")


def rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file without wall-clock columns."""
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]


def contents(run: Path) -> dict[str, bytes]:
    """Return the weights that a run has kept: the last, the best and those of its snapshots."""
    return {str(file.relative_to(run)): file.read_bytes() for file in run.rglob("*.safetensors")}


def assert_same_run(first: Path, second: Path) -> None:
    for name in ("metrics.csv", "evaluation.csv"):
        assert rows(first / name) == rows(second / name), name
        assert rows(first / name), name
    assert contents(first) == contents(second)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    """Return a run of RIS; SAC's are killed and continued in runs/test_kills.py."""
    path = tmp_path_factory.mktemp("whole") / "run"
    assert midway.train("point-u", seed=3, out=path, changes=SMALL).finished
    return path


def interrupt_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Send this process the signal of Ctrl-C once the run has taken this many steps."""
    advance = loop.advance

    def interrupted(training: Training) -> None:
        advance(training)
        if training.counters.steps == steps:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(loop, "advance", interrupted)


@pytest.mark.parametrize("stop", [20, 100, 132, 236])
def test_interrupted_and_resumed_equals_uninterrupted(
    whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    with monkeypatch.context() as patch:
        interrupt_after(patch, stop)
        run = midway.train("point-u", seed=3, out=tmp_path / "run", changes=SMALL)
    assert not run.finished
    assert Checkpoints(run.path / "checkpoints").latest() == stop
    assert midway.resume(run.path).finished
    assert_same_run(whole_run, run.path)


def test_same_seed_same_run_and_other_seed_another(whole_run: Path, tmp_path: Path) -> None:
    midway.train("point-u", seed=3, out=tmp_path / "same", changes=SMALL)
    assert_same_run(whole_run, tmp_path / "same")
    midway.train("point-u", seed=4, out=tmp_path / "other", changes=SMALL)
    assert rows(whole_run / "metrics.csv") != rows(tmp_path / "other" / "metrics.csv")


def test_killed_run_resumes_from_its_newest_whole_checkpoint(
    whole_run: Path, tmp_path: Path
) -> None:
    """SIGKILL at arbitrary moments, several times in a row, until the run is through."""
    path = tmp_path / "run"
    changes = [f"{name}={value}" for name, value in SMALL.items()]
    command = ["train", "point-u", "--seed", "3", "--out", str(path), "--set", *changes]
    process = start(command)
    wait_for(lambda: list((path / "checkpoints").glob("[0-9]*")), process)
    process.kill()
    process.wait()
    for delay in (0.0, 0.05):
        process = start(["resume", str(path)])
        wait_for(lambda: "step " in (path / "log").read_text(), process, log=path / "log")
        time.sleep(delay)
        process.kill()
        process.wait()
    assert midway.resume(path).finished
    assert_same_run(whole_run, path)


def start(arguments: list[str]) -> subprocess.Popen[bytes]:
    """Start the command line in a process of its own, its messages in the run folder's ``log``."""
    run = Path(arguments[arguments.index("--out") + 1] if "--out" in arguments else arguments[1])
    with (run / "log").open("w") if run.exists() else open(os.devnull, "w") as target:
        return subprocess.Popen(
            [sys.executable, short.__file__, *arguments],
            stderr=target,
            stdout=subprocess.DEVNULL,
        )


def wait_for(condition: object, process: subprocess.Popen[bytes], log: Path | None = None) -> None:
    """Wait until the condition holds or the process has ended of its own accord."""
    assert callable(condition)
    while not condition() and process.poll() is None:
        time.sleep(0.02)
    assert condition(), "the process ended early"


def test_resume_with_more_steps_goes_on(whole_run: Path, tmp_path: Path) -> None:
    shorter = {**SMALL, "steps": 200}
    run = midway.train("point-u", seed=3, out=tmp_path / "run", changes=shorter)
    assert run.finished
    assert midway.resume(run.path, steps=400).finished
    assert rows(run.path / "evaluation.csv") == rows(whole_run / "evaluation.csv")
    assert midway.resume(run.path, steps=300).finished
    record = json.loads((run.path / "config.json").read_text())
    assert [entry["steps"] for entry in record["resumed"]] == [400, 300]
    assert RunFolder(run.path).load_config().train.steps == 300


def test_updates_keep_their_ratio_exactly(whole_run: Path) -> None:
    for row in rows(whole_run / "evaluation.csv"):
        due = max(0, int(row["step"]) - SMALL["random_steps"]) * SMALL["updates_per_step"]
        per_call = int(SMALL["num_envs"] * SMALL["updates_per_step"])
        assert due - per_call < int(row["updates"]) <= due


def test_non_finite_loss_stops_the_run_and_keeps_the_last_good_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_episodes: None
) -> None:
    metrics = loop.metrics

    def poisoned(training: Training) -> dict[str, float]:
        if training.counters.steps > 200:
            training.totals = {
                **training.totals,
                "critic/loss": training.totals["critic/q"] * np.nan,
            }
        return metrics(training)

    monkeypatch.setattr(loop, "metrics", poisoned)
    with pytest.raises(NonFiniteError, match="critic/loss became nan"):
        midway.train("point-u", out=tmp_path / "run", changes=SMALL)
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() == 200


def test_policy_loads_alone_and_acts_like_the_run(whole_run: Path, tmp_path: Path) -> None:
    """Weights and description suffice: no checkpoint, no replay."""
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("config.json", "policy.json", "policy.safetensors"):
        (alone / name).write_bytes((whole_run / name).read_bytes())
    policy = midway.load(alone)
    config = RunFolder(whole_run).load_config()
    training = state.start(api.setup_of(config, RunFolder(whole_run)))
    checkpoints = Checkpoints(whole_run / "checkpoints")
    training = state.restore(training, checkpoints, 400)
    observation = training.collector.observation
    pair = observation["observation"], observation["desired_goal"]
    actions = policy(*pair)
    assert actions.shape == (4, 2)
    np.testing.assert_allclose(actions, loop.policy(training, "mean")(*pair), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy(pair[0][1], pair[1][1]), actions[1], rtol=1e-5, atol=1e-6)


def test_evaluation_is_reproducible_and_its_rate_is_that_of_its_episodes(whole_run: Path) -> None:
    result = midway.evaluate(whole_run, episodes=5, task="uniform", actions="sampled")
    again = midway.evaluate(whole_run, episodes=5, task="uniform", actions="sampled")
    assert result == again
    assert len(result.episodes) == 5
    assert result.success_rate == sum(e.success for e in result.episodes) / 5
    assert all(e.success == (e.final_distance < 0.5) for e in result.episodes)
    assert result != midway.evaluate(whole_run, episodes=5, task="uniform", seed=1)


def test_foreign_and_damaged_folders_are_refused(whole_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no readable run folder"):
        midway.load(tmp_path)
    folder = RunFolder(tmp_path)
    folder.config_file.write_text("{")
    with pytest.raises(ConfigurationError, match="damaged"):
        midway.resume(tmp_path)
    folder.config_file.write_text('{"format": 1}')
    with pytest.raises(ConfigurationError, match="not understood"):
        midway.resume(tmp_path)
    for name in ("config.json", "policy.json"):
        (tmp_path / name).write_bytes((whole_run / name).read_bytes())
    folder.policy_weights.write_bytes(b"nothing")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load(folder)
    with pytest.raises(ConfigurationError, match="not empty"):
        midway.train("point-u", out=whole_run)


def test_snapshots_of_the_weights_are_kept(whole_run: Path) -> None:
    kept = {path.name for path in (whole_run / "policies").iterdir()}
    assert kept - {"best.safetensors"} == {f"step-{step}.safetensors" for step in SNAPSHOTS}


def test_tensorboard_events_are_written(whole_run: Path) -> None:
    events = list((whole_run / "events").iterdir())
    assert events
    assert sum(os.path.getsize(event) for event in events) > 1_000
