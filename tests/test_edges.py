"""Values at their edges: one line and exit status 2 before anything is written."""

import subprocess
import sys
from pathlib import Path

import pytest

from midway.cli.main import main
from midway.errors import ConfigurationError
from midway.training import memory

EDGES = {
    "--seed -1": "seed -1",
    "--set batch_size=1e12": "batch_size",
    "--set replay_capacity=1e15": "replay_capacity",
    "--set updates_per_step=1e400": "updates_per_step inf: must be finite",
    "--set hidden=(0,)": "hidden",
    "--set hidden=[60000,60000]": r"needs at least \d+ GB of memory .* are available",
    "--set replay_capacity=900_000_000_000": r"replay .* GB, .* are available",
    "--set critic_learning_rate=1e30": "critic_learning_rate",
    "--set critic_learning_rate=-1": "critic_learning_rate",
    "--set discount=5": "discount",
    "--set steps=nan": "steps",
    "--steps nan": "nan is not a whole number",
    "--steps 1e400": "1e400 is not a whole number",
    "--precision f64": "invalid choice 'f64'",
}


@pytest.mark.parametrize("words", EDGES)
def test_impossible_values_are_refused_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    run = tmp_path / "run"
    with pytest.raises(SystemExit) as stop:
        main(["train", "point-u", "--agent", "sac", "--out", str(run), *words.split()])
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert said.count("\n") == 1
    with pytest.raises(ConfigurationError, match=EDGES[words]):
        raise ConfigurationError(said)
    assert not run.exists()


def test_a_renderer_that_does_not_exist_is_refused_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    words = [sys.executable, "-m", "midway.cli", "train", "point-u", "--out", str(tmp_path / "run")]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "MUJOCO_GL: nonsense" in ended.stderr


@pytest.mark.parametrize(
    ("limit", "used", "stat", "cached"), memory.GROUP_FILES, ids=["version 2", "version 1"]
)
def test_the_limit_of_a_control_group_counts(
    tmp_path: Path, limit: str, used: str, stat: str, cached: str
) -> None:
    system = tmp_path / "meminfo"
    system.write_text("MemTotal: 9 kB\nMemAvailable: 5 kB\n")
    assert memory.available(tmp_path, system) == 5 * 1024
    (tmp_path / "memory").mkdir()
    for name, text in ((limit, "4000"), (used, "3500"), (stat, f"anon 7\n{cached} 100\n")):
        (tmp_path / name).write_text(text)
    assert memory.available(tmp_path, system) == 600
    (tmp_path / limit).write_text("max")
    assert memory.available(tmp_path, system) == 5 * 1024
    assert memory.available(tmp_path / "nowhere", tmp_path / "nowhere") is None
