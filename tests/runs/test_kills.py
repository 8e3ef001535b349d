"""A run that is killed before any operation on its files goes on to the same result."""

from pathlib import Path

import kills
import pytest


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a run that was not killed, and the folder of its states before each operation."""
    folder = tmp_path_factory.mktemp("traced")
    assert kills.in_child("trace", folder / "whole", folder / "states") == 0
    return folder / "whole", folder / "states"


def test_no_state_is_said_to_be_what_it_is_not(traced: tuple[Path, Path]) -> None:
    whole, states = traced
    found = sorted(path for path in states.iterdir() if path.is_dir())
    assert len(found) > 100
    for state, later in zip(found, [*found[1:], whole], strict=True):
        for part in kills.torn(state, later):
            kills.check_state(whole, part)
        kills.check_state(whole, state)


@pytest.mark.parametrize("part", [0.02, 0.1, 0.33, 0.5, 0.75, 0.95])
def test_a_run_that_is_killed_goes_on(
    traced: tuple[Path, Path], tmp_path: Path, part: float
) -> None:
    whole, states = traced
    last = len((states / "names").read_text().splitlines())
    number = 1 + round(part * (last - 1))
    assert kills.kill_and_go_on(whole, tmp_path / "run", number) == ""


def test_a_run_that_is_killed_before_it_removes_its_oldest_checkpoint_does_so_later(
    traced: tuple[Path, Path], tmp_path: Path
) -> None:
    """There is no checkpoint after the last one to do it with."""
    whole, states = traced
    names = (states / "names").read_text().splitlines()
    [number] = [int(line[:4]) for line in names if line.endswith(" os.rename checkpoints/16")]
    assert kills.kill_and_go_on(whole, tmp_path / "run", number) == ""
