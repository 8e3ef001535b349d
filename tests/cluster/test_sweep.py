"""Sweeps on this machine."""

from pathlib import Path

import pytest

from midway.cli.main import main
from midway.cluster import sweep
from midway.cluster.jobs import Job
from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder

TINY = ["hidden=(8,)", "batch_size=8", "num_envs=4", "random_steps=16", "replay_capacity=2000"]
TINY += ["evaluate_every=60", "evaluation_episodes=2", "log_every=20", "checkpoint_every=20"]


def test_jobs_are_every_combination_with_names_of_their_own() -> None:
    jobs = sweep.jobs(["point-u", "midway/AntMaze-U-v0"], ["ris", "sac"], [0, 1], ["--preset", "x"])
    names = [job.name for job in jobs]
    assert len(set(names)) == 8
    assert names[0] == "point-u-ris-seed0"
    assert all("/" not in name for name in names)
    assert Job("point-u", "ris", 0, label="f32").name == "point-u-ris-f32-seed0"


def test_sweep_runs_everything_and_is_quick_the_second_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    command = ["sweep", "point-u", "--agents", "ris", "sac", "--seeds", "0", "--steps", "60"]
    command += ["--out", str(out), "--set", *TINY]
    main(command)
    assert capsys.readouterr().out == f"finished {out}\n"
    logs = {path.name: path.read_text() for path in out.glob("*.log")}
    assert set(logs) == {"point-u-ris-seed0.log", "point-u-sac-seed0.log"}
    shown: list[list[sweep.Status]] = []
    jobs = sweep.jobs(["point-u"], ["ris", "sac"], [0])
    final = sweep.run(jobs, out, shown.append)
    assert [status.state for status in final] == ["finished", "finished"]
    assert [status.step for status in final] == [60, 60]
    assert {path.name: path.read_text() for path in out.glob("*.log")} == logs
    assert "point-u-sac-seed0" in _text(sweep.table(shown[-1]))
    said: list[str] = []
    lines = sweep.Lines(said.append)
    for found in [*shown, shown[-1]]:
        lines(found)
    assert len(set(said)) == len(said)
    assert said[-1].startswith("point-u-")
    assert "finished" in said[-1]


def test_a_run_that_fails_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sweep"
    (out / "point-u-ris-seed0").mkdir(parents=True)
    (out / "point-u-ris-seed0" / "stranger").write_text("")
    with pytest.raises(SystemExit) as stop:
        main(["sweep", "point-u", "--agents", "ris", "--seeds", "0", "--out", str(out)])
    assert stop.value.code == 1
    assert "point-u-ris-seed0" in capsys.readouterr().err


def test_wrong_names_are_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["sweep", "point-u", "--agents", "dqn", "--out", str(tmp_path / "sweep")])
    assert stop.value.code == 2
    assert not (tmp_path / "sweep").exists()


def test_a_run_is_trained_by_one_process_at_a_time(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert not folder.in_use()
    with folder.lock():
        assert folder.in_use()
        with pytest.raises(ConfigurationError, match="another process"), folder.lock():
            pass
    assert not folder.in_use()


def _text(table: object) -> str:
    from rich.console import Console

    console = Console(width=100)
    with console.capture() as capture:
        console.print(table)
    return capture.get()
