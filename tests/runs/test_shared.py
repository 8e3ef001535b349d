"""Trackers and the hub, by packages that only write down what is asked of them."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import midway
from midway import configuration
from midway.cli.main import main
from midway.errors import ConfigurationError
from midway.runs import hub, policy, tracking
from midway.runs.callbacks import Watchers
from midway.runs.folder import RunFolder
from midway.training import state
from midway.training.evaluate import Episode, Evaluation

TINY = {"hidden": (8,), "num_envs": 4, "replay_capacity": 2_000}


@pytest.fixture
def saved(tmp_path: Path) -> tuple[RunFolder, state.Training]:
    folder = RunFolder(tmp_path / "run")
    config = configuration.configure("point-u", "sac", changes=TINY)
    folder.create(config)
    training = state.start(configuration.setup_of(config, folder))
    policy.save(folder, config, training)
    return folder, training


def test_a_tracker_is_shown_rows_and_evaluations_under_one_name(
    saved: tuple[RunFolder, state.Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[dict[str, Any]] = []
    begun: list[dict[str, Any]] = []

    def init(**options: Any) -> Any:
        begun.append(options)
        return SimpleNamespace(log=logged.append, define_metric=lambda *names, **options: None)

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    folder, training = saved
    config = folder.load_config()
    for _ in range(2):  # the run, and the process that resumes it
        watchers = Watchers(config, folder, tracking.watching("mazes"))
        assert watchers.verdict(training, {"critic/loss": 2.0}, []) == ""
    result = Evaluation("hard", "mean", (Episode(True, 5, 0.25), Episode(False, 9, 1.25)))
    assert watchers.verdict(training, {}, [result]) == ""
    assert [options["project"] for options in begun] == ["mazes", "mazes"]
    assert begun[0]["id"] == begun[1]["id"]
    assert begun[0]["config"]["train"]["num_envs"] == 4
    assert logged[0] == {"step": 0, "critic/loss": 2.0}
    assert logged[-1]["eval/hard/mean/success_rate"] == 0.5
    assert logged[-1]["eval/hard/mean/final_distance"] == 0.75


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("wandb", ["train", "point-u", "--wandb", "mazes"]),
        ("hub", ["push", "run", "me/run"]),
        ("hub", ["pull", "me/run"]),
    ],
)
def test_a_missing_package_is_one_line_that_says_what_to_install(
    package: str,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, {"hub": "huggingface_hub"}.get(package, package), None)
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"pip install 'midway[{package}]'" in line


class HubError(Exception):
    """What the hub refuses."""


def shared_by(calls: list[Any], source: Path) -> ModuleType:
    """Return a hub that holds one folder, and writes down what is asked of it."""

    class Api:
        def create_repo(self, name: str, **options: Any) -> None:
            if name == "them/run":
                raise HubError("403 Forbidden")
            calls.append((name, options))

        def upload_folder(self, **options: Any) -> str:
            calls.append(options)
            return "https://hub/me/run"

    def snapshot_download(name: str, local_dir: str, allow_patterns: list[str]) -> None:
        Path(local_dir).mkdir()
        for file in source.iterdir():
            if file.is_file() and any(file.match(pattern) for pattern in allow_patterns):
                (Path(local_dir) / file.name).write_bytes(file.read_bytes())

    package: Any = ModuleType("huggingface_hub")
    package.HfApi, package.snapshot_download = Api, snapshot_download
    package.errors = ModuleType("huggingface_hub.errors")
    package.errors.HfHubHTTPError = HubError
    return package  # type: ignore[no-any-return]


def test_a_run_is_pushed_and_pulled(
    saved: tuple[RunFolder, state.Training], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, calls = saved[0], []
    package = shared_by(calls, folder.path)
    monkeypatch.setitem(sys.modules, "huggingface_hub", package)
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", package.errors)
    assert hub.push(folder.path, "me/run", private=True) == "https://hub/me/run"
    (name, made), sent = calls
    assert (name, made["private"], sent["repo_id"]) == ("me/run", True, "me/run")
    assert "midway.pull" in (folder.path / "README.md").read_text()
    pulled = midway.pull("me/run", tmp_path / "pulled")
    assert midway.load(pulled).config == folder.load_config()
    assert not (pulled / "lock").exists()
    with pytest.raises(ConfigurationError, match="403 Forbidden"):
        hub.push(folder.path, "them/run")
    with pytest.raises(ConfigurationError, match="not empty"):
        midway.pull("me/run", tmp_path / "pulled")
