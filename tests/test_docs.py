"""The pages are true: their blocks run, and their tables name what the code writes and tests."""

import doctest
import re
import runpy
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import pytest

from midway import presets, settings
from midway.agents.registry import AGENTS
from midway.cli.main import main
from midway.envs.registry import ENVIRONMENTS
from midway.spaces import SPACE, Choice, Range
from midway.training.collect import EpisodeCounts
from midway.training.logging import EVALUATION_COLUMNS
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))

SHOWN = {"text", "toml", "yaml"}
"""Languages of blocks that are not run; one with a name is written to a file of that name."""

SMALL = {
    "steps": 60,
    "hidden": (8, 8),
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 40,
    "updates_per_step": 0.5,
    "replay_capacity": 5_000,
    "evaluate_every": 60,
    "evaluation_episodes": 2,
    "log_every": 20,
    "checkpoint_every": 60,
}
"""Settings of every run of a page, in place of those that the page gives."""


class Block(NamedTuple):
    """A fenced block: its language, the name of its file if it has one, and its text."""

    language: str
    file: str
    text: str


def blocks(page: Path) -> list[Block]:
    found = re.findall(r"^```(.*)\n((?:.*\n)*?)```$", page.read_text(), re.MULTILINE)
    return [Block(*[*info.split(), "", ""][:2], text) for info, text in found]


def commands(text: str) -> list[tuple[dict[str, str], list[str]]]:
    """Return variables and arguments of each line of a block of commands."""
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    found = []
    for words in filter(None, lines):
        first = words.index("midway")
        found.append((dict(word.split("=", 1) for word in words[:first]), words[first + 1 :]))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_every_block_is_run_or_shown_on_purpose(page: Path) -> None:
    for block in blocks(page):
        assert block.language.startswith("{") or block.language in {"python", "pycon", "sh"} | SHOWN
        if block.language == "sh":
            assert commands(block.text)


def test_the_worked_examples_print_what_they_say() -> None:
    pages = [page for page in PAGES if any(b.language == "pycon" for b in blocks(page))]
    assert pages
    for page in pages:
        failed, tried = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
        assert tried
        assert not failed


# --- blocks, run as they are written --------------------------------------------------------------


def small(resolve: Callable[..., presets.Resolved]) -> Callable[..., presets.Resolved]:
    """Return the function with runs that are over in a second."""

    def resolved(*args: object, **kwargs: object) -> presets.Resolved:
        found = resolve(*args, **kwargs)
        parts = [
            settings.changed(part, {n: v for n, v in SMALL.items() if n in settings.names(part)})
            for part in (found.train, found.hyperparameters)
        ]
        return found._replace(train=parts[0], hyperparameters=parts[1])

    return resolved


RUN = [page for page in PAGES if {"python", "sh"} & {b.language for b in blocks(page)}]


@pytest.mark.docs
@pytest.mark.extra
@pytest.mark.parametrize("page", RUN, ids=lambda path: str(path.relative_to(DOCS)))
def test_the_blocks_of_a_page_run_in_their_order(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(presets, "resolve", small(presets.resolve))
    gymnasium.registry.pop("Boat-v0", None)
    for number, block in enumerate(blocks(page)):
        name = block.file or f"block_{number}.py"
        if block.file or block.language == "python":
            (tmp_path / name).write_text(block.text)
        monkeypatch.delitem(sys.modules, Path(name).stem, raising=False)
    for number, block in enumerate(blocks(page)):
        if block.language == "python" and not block.file:
            runpy.run_path(f"block_{number}.py")
        elif block.language == "sh":
            for variables, arguments in commands(block.text):
                if folder := variables.pop("PYTHONPATH", ""):
                    sys.path.insert(0, str(ROOT / folder))
                assert not variables
                main(arguments)


# --- tables, held against the code ----------------------------------------------------------------


def table(page: str, heading: str) -> list[list[str]]:
    """Return the rows of the first table below a heading of a page, without its head."""
    _, _, below = (DOCS / page).read_text().partition(f"\n## {heading}\n")
    return _rows(below.partition("\n## ")[0])


def _rows(text: str) -> list[list[str]]:
    lines = re.findall(r"^\|(.*)\|$", text, re.MULTILINE)
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)] for line in lines]
    return rows[2:]


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def columns_of(agent: str) -> set[str]:
    """Return what an update of an agent reports, by tracing it; nothing is computed."""
    spec = EnvSpec("s", (4,), "float32", (4,), 2, 50, True, None, DistanceTask(((0, 1),), 0.5))
    entry = AGENTS[agent]
    key = jax.random.key(0)
    state = eqx.filter_eval_shape(entry.create, entry.Config(), spec, key)
    states, flags = jnp.zeros((8, 4)), jnp.zeros(8)
    batch = Batch(
        states, jnp.zeros((8, 2)), flags, flags > 1, states, states, Subgoal(states, states)
    )
    _, metrics = eqx.filter_eval_shape(entry.update, state, batch, key)
    return set(metrics)


@pytest.mark.parametrize("agent", AGENTS)
def test_the_columns_of_an_agent_are_on_the_page(agent: str) -> None:
    rows = table("metrics.md", "While learning")
    said = {names(row[0])[0] for row in rows if agent in names(row[1])[0].split()}
    assert said == columns_of(agent)


def test_the_columns_of_every_run_are_on_the_page() -> None:
    clock = {names(row[0])[0] for row in table("metrics.md", "When")}
    assert clock == {"step", "updates", "seconds", "training_seconds"}
    said = {names(row[0])[0] for row in table("metrics.md", "While collecting")}
    logged = {
        f"collect/{column}"
        for env in ENVIRONMENTS.values()
        for column in getattr(env.factory(num_envs=1), "logged_info", {}).values()
    }
    assert said == {*EpisodeCounts().metrics(), *logged}
    text = (DOCS / "metrics.md").read_text().partition("## `evaluation.csv`")[2]
    assert set(EVALUATION_COLUMNS) <= set(names(text))


def test_the_search_space_is_on_the_page() -> None:
    said: dict[str, Range | Choice] = {}
    for cell, low, high in table("tuning.md", "What is tried"):
        for name in names(cell):
            if high == "on":
                said[name] = Choice((False, True))
            elif high:
                said[name] = Range(float(low), float(high), log=True)
            else:
                said[name] = Choice(tuple(int(value) for value in low.split(",")))
    assert said == SPACE


def test_each_claim_of_the_comparison_names_a_test_that_exists() -> None:
    rows = [row for row in _rows((DOCS / "comparison.md").read_text()) if row[0] != "made for"]
    assert len(rows) > 10
    for row in rows:
        (name,) = [name for name in names(row[1]) if name.startswith("tests/")]
        file, _, test = name.partition("::")
        assert f"\ndef {test}(" in (ROOT / file).read_text(), name
