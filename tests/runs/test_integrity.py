"""Damaged, missing and foreign files of a run are found before a number of them is used."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import midway
import tiny
from midway import api
from midway.errors import ConfigurationError
from midway.runs import complete
from midway.runs.folder import RunFolder, write_json
from midway.training.checkpoint import Checkpoints

TINY = tiny.TINY | {"steps": 120}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "run"
    return midway.train("point-u", agent="sac", out=path, changes=TINY).path


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "run")


def checkpoints(run: Path) -> Checkpoints:
    folder = RunFolder(run)
    return Checkpoints(folder.checkpoints, folder.owner(folder.load_config()))


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def zero(file: Path) -> None:
    file.write_bytes(bytes(file.stat().st_size))


DAMAGES = {"flipped": flip, "cut": cut, "zeroed": zero, "missing": Path.unlink}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_every_damaged_file_of_a_checkpoint_is_found(
    run: Path, damage: Callable[[Path], None]
) -> None:
    newest = run / "checkpoints" / "120"
    for file in newest.iterdir():
        before = file.read_bytes()
        damage(file)
        with pytest.raises(ConfigurationError, match=r"step 120.*damaged.*--from 80$") as error:
            checkpoints(run).choose()
        assert "\n" not in str(error.value)
        file.write_bytes(before)
    assert checkpoints(run).choose() == 120


def test_a_file_too_many_and_a_renamed_checkpoint_are_found(run: Path) -> None:
    extra = run / "checkpoints" / "120" / "extra"
    extra.write_text("")
    with pytest.raises(ConfigurationError, match="extra does not belong"):
        checkpoints(run).choose()
    extra.unlink()
    (run / "checkpoints" / "120").rename(run / "checkpoints" / "140")
    with pytest.raises(ConfigurationError, match="expected step 140"):
        checkpoints(run).choose()


def test_a_checkpoint_of_an_earlier_version_is_refused_by_name(run: Path) -> None:
    for step in ("80", "120"):
        (run / "checkpoints" / step / "default").mkdir()
    with pytest.raises(
        ConfigurationError, match=r"step 120 was written by an earlier version.*--from 0"
    ):
        midway.resume(run)
    assert midway.load(run).step == 120


def test_an_older_checkpoint_is_taken_and_nothing_is_deleted(whole: Path, run: Path) -> None:
    flip(run / "checkpoints" / "120" / "state.npz")
    with pytest.raises(ConfigurationError, match=r"midway resume .* --from 80"):
        midway.resume(run)
    assert midway.resume(run, from_step=80).finished
    assert sorted(os.listdir(run / "checkpoints")) == ["120", "120.set-aside", "80"]
    weights = "policy.safetensors"
    assert (run / weights).read_bytes() == (whole / weights).read_bytes()


def test_a_run_whose_checkpoints_are_gone_does_not_begin_anew_in_silence(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    before = (run / "metrics.csv").read_bytes()
    with pytest.raises(ConfigurationError, match="checkpoints are gone"):
        midway.resume(run)
    for name in ("policy.json", "policy.safetensors"):
        (run / name).unlink()
    with pytest.raises(ConfigurationError, match="checkpoints are gone"):
        midway.resume(run)
    assert (run / "metrics.csv").read_bytes() == before


def test_checkpoints_of_another_run_agent_or_environment_are_refused(run: Path) -> None:
    folder = RunFolder(run)
    owner = folder.owner(folder.load_config())
    for change in ({"env": "point-s"}, {"agent": "ris"}, {"run": "other"}):
        with pytest.raises(ConfigurationError, match="of another run"):
            Checkpoints(folder.checkpoints, replace(owner, **change)).choose()
    spec = midway.make_vec("point-s").goal_spec
    with pytest.raises(ConfigurationError, match="another environment: name point-u"):
        checkpoints(run).check_spec(120, replace(spec, name="point-s"))


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors", "config.json"])
@pytest.mark.parametrize("damage", [flip, cut, zero], ids=["flipped", "cut", "zeroed"])
def test_damaged_files_of_a_policy_are_found(
    run: Path, name: str, damage: Callable[[Path], None]
) -> None:
    if name.endswith("json") and damage is cut:
        (run / name).write_text((run / name).read_text().strip())  # else a line's end is cut
    damage(run / name)
    with pytest.raises(ConfigurationError, match=rf"{name}.*(damaged|cannot be read)"):
        midway.load(run)


def test_a_policy_of_another_run_is_refused(run: Path) -> None:
    values = json.loads((run / "policy.json").read_text())
    write_json(run / "policy.json", {**values, "env": "point-s", "run": "other"})
    with pytest.raises(ConfigurationError, match="of another run"):
        midway.load(run)


def test_finished_means_everything_and_resume_writes_what_is_missing(
    whole: Path, run: Path
) -> None:
    folder = RunFolder(run)
    assert complete.missing(folder, 120) == ""
    assert complete.missing(folder, 200) == "checkpoint of step 200"
    folder.policy_weights.unlink()
    assert complete.missing(folder, 120) == "policy of step 120"
    table = folder.evaluation_file.read_text().splitlines()
    kept = [line for line in table if not line.startswith("120,")]
    folder.evaluation_file.write_text("\n".join(kept) + "\n")
    assert midway.resume(run).finished
    assert complete.missing(folder, 120) == ""
    assert folder.policy_weights.read_bytes() == (whole / "policy.safetensors").read_bytes()
    assert len(folder.evaluation_file.read_text().splitlines()) == len(table)


def test_a_refused_resume_changes_nothing_and_names_the_owner(run: Path) -> None:
    before = (run / "config.json").read_bytes()
    with (
        RunFolder(run).lock(),
        pytest.raises(ConfigurationError, match=f"another process.*pid {os.getpid()} on "),
    ):
        midway.resume(run, steps=400)
    assert (run / "config.json").read_bytes() == before
    (run / "lock").write_text('{"pid": 1, "host": "elsewhere"}')  # as a killed process leaves it
    assert not RunFolder(run).in_use()
    with RunFolder(run).lock():
        assert str(os.getpid()) in (run / "lock").read_text()


def test_a_folder_that_was_left_before_its_configuration_is_taken_anew(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for name in ("lock", "config.json.new"):
        (tmp_path / name).write_text("{")
    folder.create(api.configure("point-u"))
    folder.remove_unfinished()
    assert sorted(os.listdir(tmp_path)) == ["config.json", "lock"]


def test_files_have_the_rights_that_the_user_wants(whole: Path) -> None:
    mask = os.umask(0o22)
    os.umask(mask)
    for name in ("policy.safetensors", "policy.json", "config.json"):
        assert (whole / name).stat().st_mode & 0o777 == 0o666 & ~mask
