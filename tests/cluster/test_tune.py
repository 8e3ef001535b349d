"""Tuning, with runs that are only written down, and a cluster that is a few threads."""

import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console
from test_sweep import TINY

from midway import presets, spaces
from midway.cli.main import main
from midway.cluster import jobs, on_ray, tune
from midway.cluster.jobs import Job, Processes, State
from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder
from midway.spaces import Choice, Range

optuna = pytest.importorskip("optuna")
pytestmark = pytest.mark.extra

HEADER = "step,task,actions,success_rate\n"
SPACE = {"kl_weight": Range(0.01, 1.0, log=True), "n_step": Choice((1, 3))}
PLAN = tune.Plan("point-u", "ris", "quick", 400, (0,), SPACE, {"kl_weight": 0.1, "n_step": 1})


class Runs:
    """In place of processes: success is 1 - |kl_weight - 0.5| from the first evaluation on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun: list[Job] = []
        self.ends: dict[str, State] = {}
        monkeypatch.setattr(tune, "execute", self.execute)
        monkeypatch.setattr(tune, "POLL_SECONDS", 0.01)
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})

    def execute(
        self, job: Job, folder: Path, core: int, processes: Processes, stop: Callable[[], bool]
    ) -> State:
        self.begun.append(job)
        file = RunFolder(folder / job.name).evaluation_file
        file.parent.mkdir(exist_ok=True)
        values = dict(word.split("=") for word in job.options if "=" in word)
        success = 1 - abs(float(values["kl_weight"]) - 0.5)
        text = HEADER
        for step in (100, 200, 300, 400):
            text += f"{step},uniform,mean,{success}\n{step},hard,sampled,0.0\n"
            text += f"{step},hard,mean,{success}\n"
            file.write_text(text)
            if stop():
                return "failed"  # ended by a signal, which only the study knows the reason of
        return self.ends.get(job.label, "finished")


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    return Runs(monkeypatch)


def unseen(study: object) -> None:
    """Show nothing."""


def test_the_winner_is_a_preset_file_and_the_preset_is_the_first_trial(
    runs: Runs, tmp_path: Path
) -> None:
    study = tune.run(PLAN, 4, tmp_path / "study", unseen, "none")
    assert len(study.trials) == len(runs.begun) == 4
    assert study.trials[0].params == {"kl_weight": 0.1, "n_step": 1}
    number, score, own = tune.scores(study)
    assert own == pytest.approx(0.6)
    assert score == max(trial.value or 0 for trial in study.trials) > 0.6
    file = tmp_path / "best.toml"
    file.write_text(tune.winner(study, PLAN))
    found = presets.resolve("point-u", "ris", str(file))
    assert found.hyperparameters.kl_weight == study.trials[number].params["kl_weight"]  # type: ignore[attr-defined]
    assert found.sources["kl_weight"].source == f"tuned: trial {number} of 4"
    assert "complete" in _text(tune.table(study))


def test_trials_that_are_behind_are_stopped(runs: Runs, tmp_path: Path) -> None:
    study = tune.run(PLAN, 8, tmp_path / "study", unseen, "median")
    pruned = [trial for trial in study.trials if trial.state.name == "PRUNED"]
    assert pruned
    assert all(len(trial.intermediate_values) < 4 for trial in pruned)
    best = max(trial.value for trial in study.trials if trial.state.name == "COMPLETE")
    assert all(trial.value < best for trial in pruned)


def test_a_study_goes_on_with_the_trial_that_was_interrupted(runs: Runs, tmp_path: Path) -> None:
    runs.ends["trial1"] = "stopped"
    first = tune.open_study(PLAN, tmp_path, "none")
    distributions = {name: tune._distribution(choice) for name, choice in SPACE.items()}
    for _ in range(2):
        trial = first.ask(distributions)
        tune._try(first, trial, PLAN, tmp_path, tune._on_core(0, Processes()))
    assert [trial.state.name for trial in first.trials] == ["COMPLETE", "RUNNING"]
    runs.ends.clear()
    study = tune.run(PLAN, 3, tmp_path, unseen, "none")
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 3
    assert [job.label for job in runs.begun] == ["trial0", "trial1", "trial1", "trial2"]
    assert tune.run(PLAN, 3, tmp_path, unseen, "none").trials == study.trials
    other = tune.Plan("point-u", "ris", "quick", 800, (0,), SPACE, PLAN.first)
    with pytest.raises(ConfigurationError, match="another steps"):
        tune.open_study(other, tmp_path)


class Ray:
    """In place of the package: each task is a thread."""

    exceptions = SimpleNamespace(RayError=RuntimeError)

    def __init__(self) -> None:
        self.addresses: list[str] = []
        self._threads = ThreadPoolExecutor()

    def init(self, address: str, **options: object) -> None:
        self.addresses.append(address)

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **options: object) -> Callable[..., object]:
        return lambda function: SimpleNamespace(
            remote=lambda *arguments: self._threads.submit(function, *arguments)
        )

    def wait(self, tasks: list[Future[bool]], timeout: float) -> tuple[object, object]:
        return wait(tasks, timeout)

    def get(self, task: Future[bool]) -> bool:
        return task.result()


@pytest.fixture
def on_a_cluster(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> Ray:
    ray = Ray()
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(on_ray, "POLL_SECONDS", 0.01)

    def execute(job: Job, folder: Path, stop: Callable[[], bool]) -> State:
        return runs.execute(job, folder, 0, Processes(), lambda: time.sleep(0.05) or stop())

    monkeypatch.setattr(on_ray, "execute", execute)
    return ray


def test_trials_on_a_cluster(on_a_cluster: Ray, runs: Runs, tmp_path: Path) -> None:
    runs.ends = {"trial1": "failed"}
    study = tune.run(PLAN, 3, tmp_path, unseen, "none", "here:auto")
    assert on_a_cluster.addresses == ["here:auto"]
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert tune.run(PLAN, 3, tmp_path, unseen, "none", "auto").trials == study.trials


def test_a_trial_on_a_cluster_is_told_to_stop_by_a_file(
    on_a_cluster: Ray, runs: Runs, tmp_path: Path
) -> None:
    """By the study, or because the command ends."""
    job, ending = PLAN.job(0, 0, PLAN.first), threading.Event()
    (run, _) = on_ray.processors("auto", ending)
    assert run(job, tmp_path, lambda: True) == "failed"
    ending.set()
    assert run(job, tmp_path, lambda: False) == "stopped"
    rows = RunFolder(tmp_path / job.name).evaluation_file.read_text()
    assert "400,hard" not in rows
    assert not list(tmp_path.glob("*.stop"))


def test_failed_runs_are_no_trials_to_choose_from(runs: Runs, tmp_path: Path) -> None:
    runs.ends = {"trial0": "failed", "trial1": "failed"}
    study = tune.run(PLAN, 2, tmp_path, unseen, "hyperband")
    assert [trial.state.name for trial in study.trials] == ["FAIL", "FAIL"]
    with pytest.raises(ConfigurationError, match="no trial is complete"):
        tune.winner(study, PLAN)


def test_the_score_is_the_mean_over_tasks_evaluations_and_seeds(tmp_path: Path) -> None:
    plan = tune.Plan("point-u", "ris", "quick", 200, (0, 1), SPACE, PLAN.first)
    for seed, (hard, uniform) in enumerate((((0.0, 0.5), (0.5, 1.0)), ((0.0, 0.0), (1.0, 1.0)))):
        file = RunFolder(tmp_path / plan.job(3, seed, {}).name).evaluation_file
        file.parent.mkdir()
        rows = [
            f"{step},{task},{actions},{rate if actions == 'mean' else 1.0}\n"
            for step, *rates in ((100, hard[0], uniform[0]), (200, hard[1], uniform[1]))
            for task, rate in zip(("hard", "uniform"), rates, strict=True)
            for actions in ("mean", "sampled")
        ]
        file.write_text(HEADER + "".join(rows))
    assert tune.curve(plan, tmp_path, 3) == [(100, 0.25), (200, 0.5), (300, 0.5), (400, 0.5)]


def test_a_process_is_ended_once_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "POLL_SECONDS", 0.01)
    assert Processes().run(["sleep", "600"], tmp_path / "log", lambda: True) == -15


def test_spaces_hold_the_values_of_the_preset_and_what_the_agent_has(tmp_path: Path) -> None:
    ris = presets.resolve("ant-u", "ris", changes={"kl_weight": 0.1, "batch_size": 256})
    sac = presets.resolve("ant-u", "sac")
    space = spaces.of(ris[:2])
    assert space["n_step"] == Choice((1, 3, 5))
    assert space["advantage_temperature"] == Range(0.05, 10.0, log=True)
    assert "kl_weight" not in spaces.of(sac[:2])
    file = tmp_path / "space.toml"
    file.write_text("kl_weight = {low = 0.5, high = 1.0, log = true}\nbatch_size = [64, 128]\n")
    assert spaces.of(ris[:2], spaces.read(file)) == {
        "kl_weight": Range(0.1, 1.0, log=True),
        "batch_size": Choice((64, 128, 256)),
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("kl_weight = 3", "low, high and log"),
        ("kl_weight = {low = 1, high = 0}", "low must be below high"),
        ("kl_weight = {low = 0.0, high = 1.0, log = true}", "above 0"),
        ("kl_weight = {least = 1}", "argument"),
        ("kl_weight = [", "space"),
        ("gamma = [0.9, 0.99]", "unknown setting 'gamma'"),
        ("hidden = [256, 512]", "cannot be drawn"),
    ],
)
def test_what_is_no_space_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "space.toml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=said):
        spaces.of(presets.resolve("point-u", "ris")[:2], spaces.read(file))


def test_from_the_command_line(
    runs: Runs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "study"
    command = ["tune", "point-u", "--trials", "2", "--steps", "60", "--out", str(out)]
    main([*command, "--set", *TINY])
    said, told = capsys.readouterr()
    assert "trial 0  complete  0.600\n" in told
    assert told.count("trial 1  complete") == 1
    assert "quick itself: 0.6" in said
    assert str(out / "best.toml") in said
    header, *rows = (out / "trials.csv").read_text().splitlines()
    assert header.startswith("trial,state,score,critic_learning_rate,")
    assert [row.split(",")[:2] for row in rows] == [["0", "complete"], ["1", "complete"]]
    assert rows[0].split(",")[2] == "0.600"
    found = presets.resolve("point-u", "ris", str(out / "best.toml"))
    assert found.hyperparameters.hidden == (8,)  # type: ignore[attr-defined]
    for wrong in (["--trials", "0"], ["--set", "kl_weight=1"], ["--agent", "dqn"]):
        with pytest.raises(SystemExit) as stop:
            main(["tune", "point-u", "--out", str(out), *wrong])
        assert stop.value.code == 2


def _text(table: object) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(table)
    return capture.get()
