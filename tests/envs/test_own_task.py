"""The environment of docs/your-own-task.md, used as the document says."""

import re
import sys
from pathlib import Path

import gymnasium
import pytest
from test_foreign import TINY

import midway
from midway import reports
from midway.envs.examine import examine

DOCUMENT = Path(__file__).parents[2] / "docs" / "your-own-task.md"


@pytest.fixture
def boat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Put the document's environment into the working folder; return its name."""
    found = re.search(r"```python boat\.py\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert found is not None
    (tmp_path / "boat.py").write_text(found[1])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "boat", raising=False)
    gymnasium.registry.pop("Boat-v0", None)
    return "boat:Boat-v0"


def test_the_environment_of_the_document(boat: str, tmp_path: Path) -> None:
    findings = examine(boat, seconds=3.0)
    assert all(ok for _, _, ok in findings), findings
    text = {label: text for label, text, _ in findings}
    assert text["success"].startswith("a goal is reached within 0.1 of the goal")
    run = midway.train(
        boat, agent="sac", steps=60, out=tmp_path / "run", changes=TINY | {"replay_capacity": 900}
    )
    assert run.finished
    assert len(midway.evaluate(run.path, episodes=2).episodes) == 2
    assert reports.report([run.path])
    video = reports.watch(run.path)
    assert video.name == "uniform.mp4"
    assert video.stat().st_size > 1000
