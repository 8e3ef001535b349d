"""Agents against each other, from the CSV files that are committed."""

import json
from pathlib import Path

import pytest

from midway.cli.main import main
from midway.errors import ConfigurationError
from midway.reports import comparison
from midway.reports.comparison import compare
from midway.reports.runs import by_environment, read

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
PUSH_STATE = "push-trials/push-state-*-71d444c"


def runs(pattern: str) -> list[Path]:
    found = sorted((RESULTS).glob(pattern))
    assert found
    return found


def test_one_line_says_who_is_better_and_how_sure_that_is():
    found = compare(runs("point-mazes/point-pi-*"))
    assert found.probability.centre == 1
    assert 0.6 < found.probability.low < 0.7
    assert found.verdict == "RIS is better than SAC"
    assert str(found) in (ROOT / "docs" / "reports.md").read_text()
    other = compare(runs("point-mazes/point-pi-sac-*"), runs("point-mazes/point-pi-ris-*"))
    assert other.verdict == found.verdict
    assert other.names == ("SAC", "RIS")


def test_one_seed_of_each_says_nothing():
    found = compare(runs(PUSH_STATE), task="uniform")
    assert found.probability.centre == 1
    assert found.verdict == "nobody can tell whether RIS or SAC is better"
    assert "of 1 seed at 60,000 steps" in str(found)


def test_sides_of_the_same_settings_are_told_apart():
    seeds = runs("precision/*")
    found = compare(seeds[:2], seeds[2:])
    assert [name.split()[1] for name in found.names] == ["first", "second"]
    assert found.seeds == (2, 3)


def test_the_folder_of_a_sweep_and_numbers(capsys):
    sides = ["point-u-agents", "--against", "precision"]
    paths = [word if word.startswith("--") else str(RESULTS / word) for word in sides]
    main(["compare", *paths, "--json"])
    found = json.loads(capsys.readouterr().out)
    counts = [len(runs("point-u-agents/*")), len(runs("precision/*"))]
    assert (found["env"], found["task"], found["seeds"]) == ("point-u", "hard", counts)
    assert found["names"] == ["TDM and LEAP and CRL", "RIS"]
    assert found["probability"][0] < found["probability"][2] < 1


@pytest.mark.parametrize(
    ("first", "second", "named"),
    [
        ("point-mazes/*-seed0", "", "in one environment can be compared: point-omega, point-pi"),
        ("point-u-agents/*", "", r"here are 3 \(TDM; LEAP; CRL\): .*--against"),
        (PUSH_STATE, PUSH_STATE, "is on both sides"),
        (PUSH_STATE, "", "no evaluation of near with mean actions"),
    ],
)
def test_what_cannot_be_compared_is_refused(first, second, named):
    task = "near" if "near" in named else None
    with pytest.raises(ConfigurationError, match=named) as error:
        compare(runs(first), runs(second) if second else [], task)
    assert "\n" not in str(error.value)


def test_several_environments_are_compared_together():
    found = [read(path) for path in runs("point-mazes/point-[ps]*-seed[01]")]
    environments = by_environment(found)
    (picture,) = comparison.overview(environments)
    assert picture.stem == "all-comparison"
    hard = comparison.sides(environments, "hard")
    assert [side.group.label for side in hard] == ["RIS", "SAC"]
    # RIS reaches all goals of both mazes; SAC all of point-s and none of point-pi.
    assert hard[0].over(hard[1]).centre == 0.75
    assert f"RIS over SAC on hard task {hard[0].over(hard[1]):.0%}" in picture.description
    assert len(picture.draw().axes) == 6
