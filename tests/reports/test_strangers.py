"""Agents and environments from outside the package, and names that no file or page may trust."""

import json

import gymnasium
import pytest

from midway.agents import sac
from midway.reports import report, style
from midway.reports.runs import agent_labels, groups, read
from midway.runs.folder import write_json

OUTSIDE = sac.AGENT
"""An agent that is found by the name of this module."""

NAME = f"{__name__}:OUTSIDE"


def renamed(folder, **values):
    """Change values in the configuration of a run."""
    for name in ("config.json", "policy.json"):
        file = folder / name
        write_json(file, {**json.loads(file.read_text()), **values})
    return folder


def test_an_agent_from_outside_has_a_label_a_colour_and_file_names(sac_run, copy_run, tmp_path):
    run = renamed(copy_run(sac_run, "outside"), agent=NAME)
    (group,) = groups([read(run)])
    assert (group.label, group.slug) == ("OUTSIDE", "outside")
    assert group.colour in style.PALETTE
    _, *figures = report([run, sac_run], tmp_path / "out")
    names = {file.name for file in figures}
    assert {"point-u-outside-map.png", "point-u-sac-outside-values.png"} <= names
    for file in (tmp_path / "out").rglob("*"):
        assert style.file_name(file.name) == file.name


def test_labels_of_agents():
    assert agent_labels(["ris", "a.gcbc:AGENT", "b:CRL"]) == ["RIS", "gcbc", "CRL"]
    alike = ["a.gcbc:AGENT", "b.gcbc:AGENT"]
    assert agent_labels(alike) == alike
    assert agent_labels(["ris", "ris"]) == ["RIS", "RIS"]


def test_every_group_has_a_colour_of_its_own():
    found = style.colours([style.BLUE, None, None, style.GREEN])
    assert found[0] == style.BLUE
    assert len(set(found)) == 4


def test_file_names_hold_nothing_that_leads_elsewhere():
    assert style.file_name("../a b/c:d") == "a-b-c-d"
    assert style.file_name("///") == "unnamed"


@pytest.fixture
def foreign():
    """Register a goal environment of another package, for a test."""
    name = "strangers/Reach-v0"
    gymnasium.register(name, lambda: None)
    yield name
    del gymnasium.registry[name]


@pytest.mark.parametrize("known", [True, False])
def test_an_environment_without_a_view_has_curves_and_health(
    sac_run, copy_run, tmp_path, foreign, known
):
    name = foreign if known else "missing/Reach-v0"
    run = renamed(copy_run(sac_run, "foreign"), env=name)
    page, *figures = report([run], tmp_path / "out")
    stem = name.replace("/", "-")
    assert {file.stem for file in figures} == {f"{stem}-learning-curves", f"{stem}-health"}
    assert f"{name} has no view" in page.read_text()


def test_values_of_a_run_are_text_on_the_page(sac_run, copy_run, tmp_path):
    attack = "<script>alert(1)</script>"
    run = renamed(copy_run(sac_run, "attack"), preset=attack, command=attack, versions=attack)
    text = report([run], tmp_path / "out")[0].read_text()
    assert "<script" not in text
    assert "&lt;script&gt;" in text
    assert "default-src &#39;none&#39;" in text
