"""The policies that come with midway do what their cards say."""

import itertools
import json
from pathlib import Path

import pytest

import midway
from midway.errors import ConfigurationError
from midway.runs import folder
from midway.runs.folder import ZOO

POLICIES = sorted(found.parent.name for found in ZOO.glob("*/policy.json"))
EPISODES = 10


def card(name: str) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads((ZOO / name / "evaluation.json").read_text())
    return found


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_reaches_what_its_card_says(name: str) -> None:
    """The task with the highest rate: few episodes of a low rate say little."""
    best = max(card(name), key=lambda row: float(str(row["success_rate"])))
    task, actions = str(best["task"]), best["actions"]
    assert actions in ("mean", "sampled")
    found = midway.evaluate(f"zoo:{name}", episodes=EPISODES, task=task, actions=actions, seed=3)
    # Below a rate of p, fewer than p n - 3 sqrt(n p (1 - p)) of n succeed in one case of 700.
    rate = float(str(best["success_rate"]))
    assert found.success_rate >= rate - 3 * (rate * (1 - rate) / EPISODES) ** 0.5 - 1e-9


def test_the_zoo_has_ris_on_an_ant_maze() -> None:
    assert "ant-u-ris" in POLICIES


def test_an_unknown_name_says_which_there_are() -> None:
    with pytest.raises(ConfigurationError, match=r"zoo has .*ant-u-ris"):
        midway.load("zoo:ant-x-ris")


def test_a_wheel_finds_the_zoo_of_a_checkout_it_is_used_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = ZOO.parent
    monkeypatch.setattr(folder, "ZOO", tmp_path / "zoo")
    monkeypatch.chdir(here)
    assert midway.load("zoo:ant-u-ris").spec.name == "ant-u"
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match="comes with a checkout"):
        midway.load("zoo:ant-u-ris")


def test_a_card_names_its_command_and_commit() -> None:
    for name in POLICIES:
        text = (ZOO / name / "README.md").read_text()
        record = json.loads((Path(ZOO) / name / "config.json").read_text())
        assert record["command"] in text
        assert record["commit"] in text


def test_the_table_has_every_policy_with_what_its_card_says() -> None:
    rows = [line for line in (ZOO / "README.md").read_text().splitlines() if ".md)" in line]
    assert [row.split("]")[0] for row in rows] == [f"| [{name}" for name in POLICIES]
    for name, row in zip(POLICIES, rows, strict=True):
        rates = {(found["task"], found["actions"]): found for found in card(name)}
        columns = itertools.product(("hard", "uniform"), ("mean", "sampled"))
        assert row.removesuffix(" |").split(" | ")[2:] == [
            cell(rates[column]) for column in columns
        ]


def cell(found: dict[str, object]) -> str:
    rate, interval = found["success_rate"], found["interval"]
    assert isinstance(rate, float)
    assert isinstance(interval, list)
    return f"{100 * rate:.1f} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
