"""What midway says of an environment before it trains."""

import re
from typing import Any

import fakes
import pytest

from midway.cli.main import main
from midway.envs import layouts
from midway.envs.describing import Settings
from midway.envs.examine import Finding, examine


def found(options: dict[str, Any], settings: Settings | None = None) -> list[Finding]:
    return examine(fakes.limited, settings, num_envs=4, seconds=5.0, kwargs=options)


def test_about_ten_lines_say_what_midway_sees() -> None:
    findings = found({"ends": "cliff"})
    labels = [label for label, _, _ in findings]
    assert labels == [
        "environment",
        "observation",
        "goal",
        "actions",
        "success",
        "episodes",
        "random actions",
        "endings",
        "ranges",
        "speed",
    ]
    assert all(ok and text and "\n" not in text for _, text, ok in findings)
    text = dict((label, text) for label, text, _ in findings)
    assert text["success"].startswith("a goal is reached within 0.5 of the goal")
    assert "failure" in text["endings"]
    assert "read from Box (4,) float64" in text["observation"]


def test_ranges_are_those_of_what_was_observed() -> None:
    text = dict((label, text) for label, text, _ in found({}))
    numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*", text["ranges"])]
    low, high, least, most = numbers
    assert -10 <= low < 0 < high <= 10
    assert 0 < least < most <= high - low


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("point-u", "within 0.5 of the goal in coordinates [0, 1]"),
        ("push-state", "within 0.05 of the goal in hand and puck"),
    ],
)
def test_environments_of_midway_are_examined_as_well(name: str, rule: str) -> None:
    findings = examine(name, num_envs=4, seconds=1.0)
    assert all(ok for _, _, ok in findings)
    text = dict((label, text) for label, text, _ in findings)
    assert text["success"] == f"a goal is reached {rule}"
    assert text["actions"] == "2, from -1 to 1"
    assert "itself" in text["goal"]


@pytest.mark.parametrize(
    ("options", "settings", "fault"),
    [
        ({"reward": "dense"}, None, "does not say when a goal is reached"),
        ({"reward": "none"}, Settings(9.0), "reached before the first action"),
        ({"reward": "none", "ends": "time"}, Settings(1e-9), "give --max-episode-steps 10"),
        ({"reward": "square", "batched": False}, None, "pair by pair"),
    ],
)
def test_what_is_wrong_is_said(
    options: dict[str, Any], settings: Settings | None, fault: str
) -> None:
    assert any(fault in text and not ok for _, text, ok in found(options, settings))


def test_the_command_knows_the_environments_and_mazes_of_midway(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["check", "point-u", "--seconds", "0.1"])
    assert "point-u" in capsys.readouterr().out
    maze = layouts.names()[0]
    main(["check", "point", "--maze", maze, "--seconds", "0.1"])
    assert f"point-{maze}" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["check", "point-u", "--success-distance", "3"])
    assert "midway's own" in capsys.readouterr().err
