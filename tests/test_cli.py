"""The command line as a user types it, bad input included."""

import importlib.metadata
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import midway
from midway import presets
from midway.agents.registry import AGENTS
from midway.cli.main import main
from midway.runs.folder import RunFolder

TINY = ["hidden=(8,)", "batch_size=8", "num_envs=4", "random_steps=16", "replay_capacity=2000"]
TINY += ["evaluate_every=60", "evaluation_episodes=2", "log_every=20", "checkpoint_every=60"]


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error of one command."""
    status = 0
    try:
        main(arguments)
    except SystemExit as stop:
        status = int(stop.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "run"
    main(["train", "point-u", "--steps", "1.2e2", "--out", str(path), "--set", *TINY])
    return path


def test_train_writes_a_run_folder_and_says_where(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "run"
    arguments = ["--agent", "sac", "--steps", "60", "--out", str(path), "--set", *TINY]
    status, out, err = run(capsys, "train", "point-u", *arguments)
    assert status == 0
    assert out == f"finished {path}\n"
    assert "step 60/60" in err
    names = {file.name for file in path.iterdir()}
    assert {"config.json", "metrics.csv", "evaluation.csv", "checkpoints", "events"} <= names
    config = json.loads((path / "config.json").read_text())
    assert config["train"]["batch_size"] == 8
    assert config["agent"] == "sac"
    assert {"jax", "mujoco", "midway"} <= set(config["versions"])


def test_resume_takes_more_steps(capsys: pytest.CaptureFixture[str], trained: Path) -> None:
    status, out, _ = run(capsys, "resume", str(trained), "--steps", "180")
    assert (status, out) == (0, f"finished {trained}\n")


def test_evaluate_prints_one_json_object(capsys: pytest.CaptureFixture[str], trained: Path) -> None:
    arguments = ["--episodes", "3", "--task", "uniform", "--actions", "sampled", "--json"]
    status, out, _ = run(capsys, "evaluate", str(trained), *arguments)
    values = json.loads(out)
    assert status == 0
    assert values["success_rate"] == sum(e["success"] for e in values["episodes"]) / 3
    status, out, _ = run(capsys, "evaluate", str(trained), "--episodes", "3")
    assert status == 0
    assert "success" in out


def test_envs_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "envs", "--json")
    assert status == 0
    assert {"point-u", "ant-omega"} <= set(json.loads(out))
    status, out, _ = run(capsys, "envs")
    assert "midway/AntMaze-Pi-v0" in out
    status, out, _ = run(capsys, "doctor", "--json")
    checks = json.loads(out)
    assert status == 0
    assert checks["simulation"]["ok"]
    assert checks["device"]["ok"]


def test_version_and_help_say_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "--version")
    assert (status, out) == (0, f"midway {importlib.metadata.version('midway')}\n")
    status, out, _ = run(capsys, "train", "--help")
    words = " ".join(out.replace("│", " ").split())
    assert status == 0
    for said in (*AGENTS, *presets.NAMES, "midway presets", "midway envs", "--stop-at"):
        assert said in words


def test_settings_are_printed_for_a_maze_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "presets", "point", "ris", "--maze", "umaze")
    assert status == 0
    assert "kl_weight" in out


def test_runs_are_listed_with_their_states(
    capsys: pytest.CaptureFixture[str], trained: Path, tmp_path: Path
) -> None:
    shutil.copytree(trained, tmp_path / "whole")
    shutil.copytree(trained, tmp_path / "lost", ignore=shutil.ignore_patterns("checkpoints"))
    for name in ("begun", "busy", "sweep/damaged"):
        (tmp_path / name).mkdir(parents=True)
        shutil.copy(trained / "config.json", tmp_path / name)
    (tmp_path / "sweep/damaged/config.json").write_text("{")
    with RunFolder(tmp_path / "busy").lock():
        status, out, _ = run(capsys, "runs", str(tmp_path), "--json")
    found = {Path(name).name: row for name, row in json.loads(out).items()}
    assert status == 0
    states = {name: row["state"] for name, row in found.items()}
    expected = {"whole": "finished", "begun": "interrupted", "busy": "running"}
    assert states == expected | {"damaged": "broken", "lost": "broken"}
    assert "its policy of step" in found["lost"]["why"]
    assert found["begun"]["why"].startswith("no checkpoint of step ")
    assert found["whole"]["success"] is not None
    assert found["whole"]["step"] == found["whole"]["steps"]
    status, out, _ = run(capsys, "runs", str(tmp_path))
    assert len(out.splitlines()) == 5
    assert "is damaged" in out
    status, out, _ = run(capsys, "runs", str(tmp_path / "whole"))
    assert out.startswith(str(tmp_path / "whole"))
    status, _, err = run(capsys, "runs", str(tmp_path / "nowhere"))
    assert status == 2
    assert "there is no folder" in err


def test_export_writes_files_and_says_how_far_they_are_off(
    capsys: pytest.CaptureFixture[str], trained: Path, tmp_path: Path
) -> None:
    arguments = ["export", str(trained), "--out", str(tmp_path)]
    status, out, _ = run(capsys, *arguments, "--numpy")
    assert status == 0
    assert out.startswith(f"{tmp_path}/policy.py: actions within ")
    assert {path.name for path in tmp_path.iterdir()} == {"policy.py", "policy.npz"}
    status, _, err = run(capsys, *arguments)
    assert status == 2
    assert "--onnx" in err


def test_bench_prints_figures_with_the_machine(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "bench", "env", "--env", "point-u", "--num-envs", "2", "--json")
    values = json.loads(out)
    assert status == 0
    assert values["env"]["steps_per_s"] > 0
    assert values["machine"]["cores"] >= 1


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "train"),
        (["fly"], "fly"),
        (["train"], "STR"),
        (["train", "point-x"], "point-x"),
        (["train", "point-u", "--agent", "dqn"], "dqn"),
        (["train", "point-u", "--preset", "slow"], "slow"),
        (["train", "point-u", "--stepz", "5"], "--stepz"),
        (["train", "point-u", "--steps", "1.5"], "1.5"),
        (["train", "point-u", "--steps", "-5"], "-5"),
        (["train", "point-u", "--stop-at", "95"], "stop_at 95"),
        (["train", "point-u", "--overwrite", "--out", "/proc/self"], "/proc/self"),
        (["train", "point-u", "--precision", "f16"], "f16"),
        (["train", "point-u", "--seed", "1", "--seed", "2"], "--seed is given twice"),
        (["sweep", "point-u", "--seeds", "0", "--seeds=1"], "--seeds is given twice"),
        (["train", "point-u", "--set", "batch"], "batch"),
        (["train", "point-u", "--set", "batches=3"], "batches"),
        (["train", "point-u", "--set", "batch_size=many"], "many"),
        (["train", "point-u", "--set", "relabel=(0.5,0.4,0.4)"], "0.5"),
        (["train", "point-u", "--set", "replay_capacity=100"], "100"),
        (["train", "point-u", "--set", "random_steps=1"], "random_steps"),
        (["train", "point-u", "--out", "/proc/nowhere/run"], "/proc/nowhere/run"),
        (["resume", "/no/such/folder"], "/no/such/folder"),
        (["evaluate", "/no/such/folder"], "/no/such/folder"),
        (["evaluate", "RUN", "--task", "easy"], "easy"),
        (["evaluate", "RUN", "--episodes", "0"], "0"),
    ],
)
def test_wrong_use_is_one_clear_line_and_status_2(
    capsys: pytest.CaptureFixture[str], trained: Path, arguments: list[str], named: str
) -> None:
    arguments = [str(trained) if argument == "RUN" else argument for argument in arguments]
    status, out, err = run(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert err.startswith("midway: ")
    assert err.count("\n") == 1
    assert named in err


@pytest.mark.parametrize(
    "words",
    [
        ["--set", "batch_size=7", "layer_norm=true"],
        ["--set", "batch_size=7", "--set", "layer_norm=true"],
    ],
)
def test_settings_follow_one_set_or_one_each(
    capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    status, out, _ = run(capsys, "presets", "point-u", "sac", *words)
    given = [line.split()[:2] for line in out.splitlines() if line.rstrip().endswith("given")]
    assert status == 0
    assert given == [["batch_size", "7"], ["layer_norm", "True"]]


def test_full_disk_fails_in_one_line_and_keeps_the_last_checkpoint(
    trained: Path, tmp_path: Path
) -> None:
    """A limit on the size of files stands for a full disk: both make a write fail."""
    path = tmp_path / "run"
    main(["train", "point-u", "--steps", "60", "--out", str(path), "--set", *TINY])
    before = {file.name for file in (path / "checkpoints").iterdir()}

    resume = f"{sys.executable} -m midway.cli resume {path} --steps 240"
    result = subprocess.run(
        ["bash", "-c", f"export XDG_CACHE_HOME={tmp_path}; ulimit -f 4; exec {resume}"],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].startswith("midway: ")
    assert before <= {file.name for file in (path / "checkpoints").iterdir()}
    assert midway.resume(path, steps=120).finished


def test_module_runs_as_a_program(trained: Path) -> None:
    command = [sys.executable, "-m", "midway.cli", "evaluate", str(trained), "--episodes", "2"]
    result = subprocess.run([*command, "--json"], capture_output=True, text=True)
    assert result.returncode == 0
    assert len(json.loads(result.stdout)["episodes"]) == 2
