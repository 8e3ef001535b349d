"""Full disks, signals and broken environments end a run with a reason, and nothing is lost."""

import csv
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import midway
import short
import tiny
from midway.api import Run
from midway.cli.main import main
from midway.errors import BrokenEnvironmentError, NonFiniteObservationError
from midway.replay.buffer import num_transitions
from midway.runs import complete
from midway.runs.folder import RunFolder
from midway.training import loop, signals
from midway.training.checkpoint import steps_in
from midway.training.collect import Collector
from midway.training.events import Events
from midway.training.state import Training

pytestmark = pytest.mark.usefixtures("short_episodes")

TINY = tiny.TINY | {"steps": 120}
CHANGES = [f"{name}={value}" for name, value in TINY.items()]


def command(out: Path) -> list[str]:
    return ["train", "point-u", "--agent", "sac", "--out", str(out), "--set", *CHANGES]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    path = tmp_path_factory.mktemp("whole") / "run"
    return midway.train("point-u", agent="sac", out=path, changes=TINY).path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [
            {name: value for name, value in row.items() if "seconds" not in name}
            for row in csv.DictReader(file)
        ]


def assert_same_run(first: Path, second: Path) -> None:
    for name in ("metrics.csv", "evaluation.csv"):
        assert rows(first / name) == rows(second / name)
    weights = [(run / "policy.safetensors").read_bytes() for run in (first, second)]
    assert weights[0] == weights[1]


def train(out: Path, **changes: object) -> Run:
    return midway.train("point-u", agent="sac", out=out, changes=TINY | changes)


# --- disks ----------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a file system of 60 kB, less than a checkpoint takes."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=60k", "none", path], check=False)
    if mounted.returncode:
        pytest.skip("needs the right to mount")
    yield path
    subprocess.run(["umount", path], check=True)


def test_a_full_disk_ends_the_run_with_its_reason_and_it_goes_on_with_room(
    whole: Path, small_disk: Path
) -> None:
    run = small_disk / "run"
    words = [sys.executable, "-m", "midway.cli", *command(run)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 1
    assert "No space left" in ended.stderr.splitlines()[-1]
    assert "Traceback" not in ended.stderr
    subprocess.run(["mount", "-o", "remount,size=20m", small_disk], check=True)
    assert midway.resume(run).finished
    assert_same_run(whole, run)


def test_a_run_goes_on_without_events(tmp_path: Path) -> None:
    said: list[str] = []
    events = Events(tmp_path / "events", 0, said.append)
    size = sum(path.stat().st_size for path in (tmp_path / "events").iterdir())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, hard))
    try:
        for step in range(3):
            events.scalars(step, {"loss": 1.0, "other": 2.0})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    events.close()
    assert len(said) == 1
    assert "no more events for TensorBoard" in said[0]


def test_a_folder_that_is_gone_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    advance = loop.advance

    def and_remove(training: Training) -> None:
        advance(training)
        if training.counters.steps == 48:
            (tmp_path / "run").rename(tmp_path / "elsewhere")

    with monkeypatch.context() as patch:
        patch.setattr(loop, "advance", and_remove)
        with pytest.raises(SystemExit) as stop:
            main(command(tmp_path / "run"))
    assert stop.value.code == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("midway: ")
    assert midway.resume(tmp_path / "elsewhere").finished


# --- signals --------------------------------------------------------------------------------------


def signal_at(
    monkeypatch: pytest.MonkeyPatch, name: str, number: int, when: Callable[..., bool]
) -> None:
    """Send this process a signal before a function of the loop is called."""
    original = getattr(loop, name)

    def and_signal(*arguments: object) -> object:
        if when(*arguments):
            signal.raise_signal(number)
        return original(*arguments)

    monkeypatch.setattr(loop, name, and_signal)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU])
def test_signals_end_a_run_with_a_checkpoint_and_their_status(
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    # Under nohup the tests themselves ignore SIGHUP, and a run then does too.
    monkeypatch.setattr(signals, "_is_ignored", lambda number: False)
    with monkeypatch.context() as patch:
        signal_at(patch, "advance", number, lambda training: training.counters.steps == 68)
        with pytest.raises(SystemExit) as stop:
            main(command(run))
    assert stop.value.code == 128 + number
    assert capsys.readouterr().out == f"stopped; continue with: midway resume {run}\n"
    assert max(steps_in(run / "checkpoints")) == 72
    assert midway.resume(run).finished
    assert_same_run(whole, run)


def test_a_step_that_does_not_return_ends_the_run_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, over, said = tmp_path / "run", threading.Event(), []

    def leave(number: int, last_line: Callable[[], str]) -> None:
        said.append((number, last_line()))
        over.set()

    def block(env: Any) -> None:
        saving = run / "checkpoints" / "68.new"
        saving.mkdir()
        signal.raise_signal(signal.SIGTERM)
        assert not over.wait(0.3)  # a checkpoint that is being written is waited for
        saving.rmdir()
        over.wait()

    monkeypatch.setattr(signals, "GRACE", 0.1)
    monkeypatch.setattr(signals, "_leave", leave)
    at_step(monkeypatch, 64, block)
    with pytest.raises(SystemExit) as stop:
        main(command(run))
    assert stop.value.code == 128 + signal.SIGTERM
    goes_on = f"go on from the checkpoint of step 40: midway resume {run}"
    assert said == [(signal.SIGTERM, f"interrupted in the middle of a step; {goes_on}")]


@pytest.mark.parametrize("step", [60, 120])
def test_an_interrupted_evaluation_is_repeated(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    with monkeypatch.context() as patch:
        signal_at(patch, "evaluate", signal.SIGINT, lambda t, _: t.counters.steps == step)
        run = train(tmp_path / "run")
    assert (run.finished, run.signal) == (False, signal.SIGINT)
    assert (
        all(row["step"] != str(step) for row in rows(run.path / "evaluation.csv"))
        if (run.path / "evaluation.csv").exists()
        else step == 60
    )
    assert midway.resume(run.path).finished
    assert_same_run(whole, run.path)


class Killed(BaseException):
    """The process ends here."""


def test_a_process_that_is_killed_while_it_repeats_an_evaluation_is_not_finished(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    table = run / "evaluation.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(line for line in lines if not line.startswith("120,")))
    replace = Path.replace

    def kill(written: Path, name: Path) -> Path:
        if name == table and "\n120," in written.read_text():
            raise Killed
        return replace(written, name)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", kill)
        with pytest.raises(Killed):
            midway.resume(run)
    assert complete.missing(RunFolder(run), 120) == "evaluation of step 120"
    assert midway.resume(run).finished
    assert_same_run(whole, run)


def test_usr1_writes_a_checkpoint_and_goes_on(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    with monkeypatch.context() as patch:
        signal_at(patch, "advance", signal.SIGUSR1, lambda t: t.counters.steps == 64)
        progress = loop._obey

        def look(training: Training, *others: object) -> None:
            seen.append(steps_in(tmp_path / "run" / "checkpoints"))
            progress(training, *others)

        patch.setattr(loop, "_obey", look)
        assert train(tmp_path / "run").finished
    assert any(68 in steps for steps in seen)
    assert_same_run(whole, tmp_path / "run")


def test_pretraining_ends_at_once_and_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = TINY | {"vae_states": 300, "vae_rounds": 2, "vae_updates": 2, "plan_samples": 8}
    with monkeypatch.context() as patch:
        patch.setattr("midway.training.pretrain.np.random.default_rng", _interrupting)
        run = midway.train("point-u", agent="leap", out=tmp_path / "run", changes=changes)
    assert (run.finished, run.signal) == (False, signal.SIGTERM)
    assert not (run.path / "pretrained.safetensors").exists()
    assert midway.resume(run.path).finished


def _interrupting(seed: int) -> np.random.Generator:
    signal.raise_signal(signal.SIGTERM)
    return np.random.Generator(np.random.PCG64(seed))


def test_a_closed_pipe_of_standard_error_does_not_end_a_run(whole: Path, tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, short.__file__, *command(tmp_path / "run")]
    ended = subprocess.run(words, stderr=writing, stdout=subprocess.PIPE, check=False)
    os.close(writing)
    assert ended.returncode == 0
    assert_same_run(whole, tmp_path / "run")


# --- environments ---------------------------------------------------------------------------------


def at_step(monkeypatch: pytest.MonkeyPatch, step: int, act: Callable[[Any], None]) -> None:
    """Do something with the environments once the run has taken this many steps."""
    advance = loop.advance

    def and_act(training: Training) -> None:
        if training.counters.steps == step:
            act(training.collector.env)
        advance(training)

    monkeypatch.setattr(loop, "advance", and_act)


def test_a_number_that_is_not_finite_never_enters_the_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def show_nan(env: Any) -> None:
        encode = env._encode

        def once(*state: Any) -> Any:
            env._encode = encode
            observation = encode(*state)
            observation[2, 0] = np.nan
            return observation

        env._encode = once

    with monkeypatch.context() as patch:
        at_step(patch, 64, show_nan)
        with pytest.raises(
            NonFiniteObservationError,
            match=r"point-u: environment 2 .* in step \d+ of its episode, after action \[.*step 68",
        ):
            train(tmp_path / "run")
    assert max(steps_in(tmp_path / "run" / "checkpoints")) == 68
    assert midway.resume(tmp_path / "run").finished
    assert all(np.isfinite(float(row["critic/loss"])) for row in rows(tmp_path / "run/metrics.csv"))


def test_an_episode_whose_simulation_diverges_is_withdrawn_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = [0]
    take = Collector.step

    def and_count(collector: Collector, replay: Any, choose: Any) -> Any:
        length, before = int(collector.env._elapsed[2]), collector.counts.diverged
        replay = take(collector, replay, choose)
        change = int(num_transitions(replay)) - stored[0]
        assert change == (3 - length if collector.counts.diverged > before else 4)
        stored[0] += change
        return replay

    monkeypatch.setattr(Collector, "step", and_count)

    def throw(env: Any) -> None:
        simulate = env._simulate

        def once() -> None:
            env._simulate = simulate
            simulate()
            env._qvel[2] = 1e300

        env._simulate = once

    at_step(monkeypatch, 64, throw)
    assert train(tmp_path / "run").finished
    found = rows(tmp_path / "run" / "metrics.csv")
    assert {row["step"]: float(row["collect/diverged"]) for row in found}["80"] == 1
    assert sum(float(row["collect/diverged"]) for row in found) == 1
    assert all(np.isfinite(float(row["critic/loss"])) for row in found)


def test_evaluation_of_an_environment_that_breaks_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = loop.run_episodes

    def breaking(*arguments: object) -> object:
        raise BrokenEnvironmentError("line: environment 0 broke")

    with monkeypatch.context() as patch:
        patch.setattr(loop, "run_episodes", breaking)
        with pytest.raises(BrokenEnvironmentError, match=r"broke; go on from .* step 120"):
            train(tmp_path / "run")
    assert original is loop.run_episodes
    assert midway.resume(tmp_path / "run").finished
    assert {row["step"] for row in rows(tmp_path / "run" / "evaluation.csv")} == {"120"}
