"""An agent from outside the package is used exactly as one from inside (examples/gcbc.py)."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import midway
import short
from midway.agents import registry
from midway.cli.main import main
from midway.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("short_episodes")

EXAMPLES = Path(__file__).parents[1] / "examples"
SMALL = {
    "hidden": (16, 16),
    "batch_size": 16,
    "num_envs": 4,
    "random_steps": 40,
    "replay_capacity": 2_000,
    "evaluate_every": 200,
    "evaluation_episodes": 2,
    "log_every": 100,
    "checkpoint_every": 100,
}


def cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own that finds the example."""
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES)}
    command = [sys.executable, short.__file__, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_the_example_is_short() -> None:
    assert len((EXAMPLES / "gcbc.py").read_text().splitlines()) < 120


def test_from_the_command_line_to_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trained and continued in processes of their own, then looked at in this one."""
    run = tmp_path / "run"
    changes = [f"{name}={value}".replace(" ", "") for name, value in SMALL.items()]
    train = ["train", "point-u", "--agent", "gcbc:AGENT", "--steps", "200", "--out", str(run)]
    done = cli(*train, "--set", *changes)
    assert done.returncode == 0, done.stderr
    assert json.loads((run / "config.json").read_text())["agent"] == "gcbc:AGENT"
    assert cli("resume", str(run), "--steps", "300").returncode == 0
    monkeypatch.syspath_prepend(EXAMPLES)
    main(["evaluate", str(run), "--episodes", "3", "--task", "uniform", "--json"])
    assert len(json.loads(capsys.readouterr().out)["episodes"]) == 3
    main(["report", str(run)])
    assert (run / "figures" / "report.html").exists()
    main(["watch", str(run), "--out", str(tmp_path / "video.gif")])
    assert (tmp_path / "video.gif").stat().st_size > 1000


def test_an_agent_itself_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    agent = importlib.import_module("gcbc").AGENT
    changes = SMALL | {"steps": 100}
    run = midway.train("point-u", agent=agent, out=tmp_path / "run", changes=changes)
    assert run.finished
    policy = midway.load(run.path)
    assert policy.agent is agent
    assert registry.name_of(agent) == "gcbc:AGENT"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("dqn", "choose one of ris"),
        ("no_such_module:AGENT", "no_such_module"),
        ("math:pi", "not a midway Agent"),
        ("math:nothing", "nothing"),
    ],
)
def test_what_is_no_agent_is_refused_in_one_line(name: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as error:
        registry.get(name)
    assert "\n" not in str(error.value)
