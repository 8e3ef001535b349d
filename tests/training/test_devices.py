"""Several devices: the same run as on one, its replay and its batches divided."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import midway
from midway import api
from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder
from midway.training import state


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``on_devices.py`` wrote on four virtual devices."""
    path = tmp_path_factory.mktemp("devices")
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4"
    subprocess.run(
        [sys.executable, Path(__file__).with_name("on_devices.py"), path],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        check=True,
    )
    return path


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((folder / "found.json").read_text())
    return values


def assert_same_up_to_rounding(first: Path, second: Path) -> None:
    one, two = np.load(first), np.load(second)
    assert set(one) == set(two)
    for name in one:
        if np.issubdtype(one[name].dtype, np.integer):
            np.testing.assert_array_equal(one[name], two[name], err_msg=name)
        else:
            np.testing.assert_allclose(one[name], two[name], rtol=1e-4, atol=1e-5, err_msg=name)


def test_four_devices_compute_what_one_computes(folder: Path) -> None:
    """Networks, optimisers, sums of metrics and the whole replay after several updates."""
    assert_same_up_to_rounding(folder / "start-1.npz", folder / "start-4.npz")


@pytest.mark.parametrize(("written_on", "continued_on"), [(1, 4), (4, 1)])
def test_runs_continue_on_another_number_of_devices(
    folder: Path, written_on: int, continued_on: int
) -> None:
    continued = folder / f"{written_on}-then-{continued_on}.npz"
    assert_same_up_to_rounding(folder / "1-then-1.npz", continued)
    assert not np.array_equal(
        np.load(continued)["replay.num_rows"], np.load(folder / "start-1.npz")["replay.num_rows"]
    )


def test_each_device_holds_its_lanes_and_all_networks(found: dict[str, Any]) -> None:
    assert found["lanes"] == [2, 2, 2, 2]
    assert set(found["replicas"]) == {4}


def test_devices_send_rows_that_are_drawn_and_never_the_replay(found: dict[str, Any]) -> None:
    assert found["largest_sent"] < found["numbers_in_a_lane"]


def test_each_device_encodes_the_images_of_its_lanes(found: dict[str, Any]) -> None:
    assert found["lanes_of_features"] == [2, 2, 2, 2]
    assert found["difference_of_features"] < 1e-5 < found["largest_feature"]


def test_everything_compiles_once_and_is_written_in_place(found: dict[str, Any]) -> None:
    assert found["compilations"] == {"train": 1, "act": 1}
    assert found["in_place"]
    assert all(found["given_away"])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"devices": 3, "num_envs": 8, "batch_size": 12}, "num_envs 8"),
        ({"devices": 4, "num_envs": 8, "batch_size": 6}, "batch_size 6"),
        ({"devices": 0}, "devices 0"),
    ],
)
def test_rows_that_cannot_be_divided_are_refused(changes: dict[str, int], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        api.configure("point-u", changes=changes)


def test_more_devices_than_there_are_is_refused(tmp_path: Path) -> None:
    config = api.configure("point-u", changes={"devices": 2})
    with pytest.raises(ConfigurationError, match="devices 2: this machine has 1"):
        state.start(api.setup_of(config, RunFolder(tmp_path)))
    RunFolder(tmp_path / "run").create(api.configure("point-u"))
    with pytest.raises(ConfigurationError, match="devices 2: this machine has 1"):
        midway.resume(tmp_path / "run", devices=2)
