"""Checkpoints: what is written is whole or not there, and what does not fit is refused by name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from midway import files
from midway.errors import ConfigurationError
from midway.training import archive
from midway.training.checkpoint import Checkpoints, Owner

STATE = {"agent": {"weight": np.arange(6.0)}}


@pytest.fixture
def checkpoints(tmp_path: Path) -> Checkpoints:
    """Return checkpoints of which that of step 8 is there."""
    there = Checkpoints(tmp_path / "checkpoints", Owner("a run", "point-u", "ris"))
    there.save(8, STATE)
    return there


def manifest_says(tmp_path: Path, **changes: Any) -> None:
    """Change what the checkpoint of step 8 says of itself, with a checksum that fits."""
    path = tmp_path / "checkpoints" / "8" / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest[files.SEAL]
    path.write_text(json.dumps(files.sealed({**manifest, **changes})))


def test_a_checkpoint_that_cannot_be_written_leaves_those_before_it(
    checkpoints: Checkpoints, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, state: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archive, "write", full)
    with pytest.raises(OSError, match=r"checkpoint of step 16 cannot be written: .*No space left"):
        checkpoints.save(16, STATE)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["8"]
    assert checkpoints.choose() == 8


def test_a_step_that_is_there_is_not_written_again(checkpoints: Checkpoints) -> None:
    checkpoints.save(8, {"agent": {"weight": np.zeros(6)}})
    np.testing.assert_array_equal(checkpoints.restore(8, STATE)["agent"]["weight"], np.arange(6.0))


def test_what_a_dead_process_left_is_removed(checkpoints: Checkpoints, tmp_path: Path) -> None:
    left = tmp_path / "checkpoints" / f"16{files.UNFINISHED}"
    left.mkdir()
    checkpoints.save(24, STATE)
    assert not left.exists()
    assert checkpoints.steps() == [8, 24]


def test_each_checkpoint_that_is_set_aside_has_a_name_of_its_own(
    checkpoints: Checkpoints, tmp_path: Path
) -> None:
    for _ in range(3):
        checkpoints.save(16, STATE)
        checkpoints.set_aside_after(8)
    found = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert found == ["16.set-aside", "16.set-aside-2", "16.set-aside-3", "8"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"step": 9}, "says it is of step 9, format 2; expected step 8, format 2"),
        ({"format": 7}, "format 7; expected step 8, format 2"),
        ({"spec": "a maze"}, "not understood: spec 'a maze'"),
        ({"parts": [1]}, r"not understood: parts \[1\]"),
        ({"owner": {"env": "ant-u"}}, "of another run: env 'ant-u', expected 'point-u'"),
        ({"owner": 3}, "not understood"),
        ({"files": {}}, "state.npz does not belong to it"),
        ({"files": {"other.npz": "0"}}, "other.npz is missing"),
        ({"files": {"state.npz": "0"}}, "SHA-256 of state.npz"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused_by_name(
    checkpoints: Checkpoints, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    manifest_says(tmp_path, **changes)
    with pytest.raises(ConfigurationError, match=f"checkpoint of step 8.*{reason}"):
        checkpoints.verify(8)


def test_a_manifest_without_a_checksum_is_damaged(checkpoints: Checkpoints, tmp_path: Path) -> None:
    for content in ("[]", "{}", "{"):
        (tmp_path / "checkpoints" / "8" / "manifest.json").write_text(content)
        with pytest.raises(ConfigurationError, match="checkpoint of step 8 is damaged"):
            checkpoints.verify(8)


def test_steps_and_states_that_are_not_there_are_named(checkpoints: Checkpoints) -> None:
    with pytest.raises(ConfigurationError, match=r"step 16 is not there.*--from 8"):
        checkpoints.choose(16)
    other = {"agent": {"weight": np.zeros(7)}}
    with pytest.raises(ConfigurationError, match=r"checkpoint of step 8: .*agent/weight"):
        checkpoints.restore(8, other)
