"""Callbacks see what a run writes, change nothing, and end it whole."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import midway
import tiny
from midway import tables
from midway.api import Run
from midway.cluster.jobs import Job, finished
from midway.errors import ConfigurationError
from midway.runs import complete
from midway.runs.callbacks import IN_A_ROW, Event
from midway.runs.folder import RunFolder
from midway.training import loop
from midway.training.evaluate import Episode, Evaluation

pytestmark = pytest.mark.usefixtures("short_episodes")

TINY = tiny.TINY | {"random_steps": 16, "checkpoint_every": 60, "steps": 120}


def train(path: Path, **options: Any) -> Run:
    return midway.train("point-u", agent="sac", out=path, **{"changes": TINY, **options})


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    return train(tmp_path_factory.mktemp("whole") / "run").path


def test_callbacks_see_what_is_written_and_change_nothing(whole: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    policies = []

    def watch(event: Event) -> None:
        events.append(event)
        policies.append(event.policy)

    run = train(tmp_path / "run", callbacks=[watch])
    rows, taken = tables.read(run.path / "metrics.csv"), [e for e in events if e.evaluations]
    written = tables.read(run.path / "evaluation.csv")
    last = [event for event in events if event.metrics][-1]
    assert last.metrics["critic/loss"] == rows["critic/loss"][-1]
    assert {event.step for event in events if event.metrics} == set(rows["step"])
    assert [e.step for e in taken for _ in e.evaluations] == list(written["step"])
    assert {event.path for event in events} == {run.path}
    assert run.finished
    for name in ("policy.safetensors", "checkpoints/120/manifest.json"):
        assert (run.path / name).exists()
    weights = "policy.safetensors"
    assert (run.path / weights).read_bytes() == (whole / weights).read_bytes()
    pair = np.ones((2, 4), np.float32), np.zeros((2, 4), np.float32)
    assert policies[-1].step == 120
    np.testing.assert_array_equal(policies[-1](*pair), midway.load(run.path)(*pair))
    assert (policies[0](*pair) != policies[-1](*pair)).any()  # a copy of its own


def test_a_run_that_a_callback_ends_is_finished_and_can_go_on(whole: Path, tmp_path: Path) -> None:
    run = train(tmp_path / "run", callbacks=[lambda event: event.step >= 80])
    assert run.finished
    folder = RunFolder(run.path)
    assert complete.missing(folder, 120) == ""
    assert complete.policy_step(folder) == 80
    assert tables.read(folder.evaluation_file)["step"].max() == 80
    assert midway.resume(run.path).finished
    assert complete.policy_step(folder) == 80
    assert midway.resume(run.path, steps=120).finished
    assert complete.missing(folder, 120) == ""
    assert folder.ended_at() is None
    policies = [path / "policy.safetensors" for path in (whole, run.path)]
    assert policies[0].read_bytes() == policies[1].read_bytes()


def test_success_ends_a_run_after_some_evaluations_in_a_row_wherever_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the episodes succeed until step 60, and three quarters from then on."""
    step = [0]

    def episodes(env: Any, actor: Any, task: str, actions: Any, *others: Any) -> Evaluation:
        good = 2 if step[0] <= 60 else 3
        reached = [Episode(number < good, 5, 0.1) for number in range(4)]
        return Evaluation(task, actions, tuple(reached))

    def count(training: Any) -> None:
        advance(training)
        step[0] = training.counters.steps

    def interrupt(event: Event) -> None:
        if event.step == 100 and event.evaluations:
            signal.raise_signal(signal.SIGINT)

    advance = loop.advance
    monkeypatch.setattr(loop, "run_episodes", episodes)
    monkeypatch.setattr(loop, "advance", count)
    changes = TINY | {"evaluate_every": 20, "steps": 400}
    end = 60 + 20 * IN_A_ROW
    run = train(tmp_path / "sweep" / "point-u-sac-seed0", changes=changes, stop_at=0.75)
    assert run.finished
    assert RunFolder(run.path).ended_at() == complete.policy_step(RunFolder(run.path)) == end
    assert finished(Job("point-u", "sac", 0), tmp_path / "sweep")
    stopped = train(tmp_path / "run", changes=changes, stop_at=0.75, callbacks=[interrupt])
    assert not stopped.finished
    assert midway.resume(stopped.path).finished
    policies = [path / "policy.safetensors" for path in (run.path, stopped.path)]
    assert policies[0].read_bytes() == policies[1].read_bytes()
    with pytest.raises(ConfigurationError, match="stop_at"):
        midway.resume(run.path, stop_at=1.5)
    assert RunFolder(run.path).ended_at() == end
    assert midway.resume(run.path, stop_at=1.0, steps=180).finished
    assert complete.policy_step(RunFolder(run.path)) == 180


def test_only_a_run_that_nobody_trains_is_overwritten(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigurationError, match="is no run folder"):
        train(path, overwrite=True)
    assert (path / "thesis.tex").exists()
    (path / "thesis.tex").unlink()
    train(path, overwrite=True, callbacks=[lambda event: True])
    assert complete.policy_step(RunFolder(path)) == 20
    with RunFolder(path).lock(), pytest.raises(ConfigurationError, match="another process"):
        train(path, overwrite=True)
    assert complete.policy_step(RunFolder(path)) == 20
    with pytest.raises(ConfigurationError, match="--overwrite"):
        train(path)
    (path / "figures").mkdir()
    assert train(path, overwrite=True).finished
    assert not (path / "figures").exists()
    assert (path / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()


def test_a_folder_without_a_name_does_not_collide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "point-u-sac-seed0").mkdir(parents=True)
    run = midway.train("point-u", agent="sac", changes=TINY, callbacks=[lambda event: True])
    assert run.path == Path("runs/point-u-sac-seed0-2")
