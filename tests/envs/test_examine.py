"""What midway says of an environment before it trains."""

from typing import Any

import fakes
import pytest

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
        "speed",
    ]
    assert all(ok and text and "\n" not in text for _, text, ok in findings)
    text = dict((label, text) for label, text, _ in findings)
    assert text["success"].startswith("a goal is reached within 0.5 of the goal")
    assert "failure" in text["endings"]
    assert "read from Box (4,) float64" in text["observation"]


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
