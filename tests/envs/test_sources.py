"""Environments that are not midway's are found by names, callables and objects."""

import functools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fakes
import gymnasium
import pytest

from midway.envs import packages
from midway.envs.describing import Settings, describe
from midway.envs.sources import Source, UnknownEnvironmentError, source
from midway.errors import ConfigurationError


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("tests/Plane-v0", fakes.Plane, max_episode_steps=20)
    yield
    gymnasium.registry.pop("tests/Plane-v0", None)


def made() -> gymnasium.Env[Any, Any]:
    return fakes.limited(reward="plus")


@pytest.mark.parametrize(
    ("env", "reference"),
    [
        ("tests/Plane-v0", "tests/Plane-v0"),
        ("fakes:tests/Plane-v0", "fakes:tests/Plane-v0"),
        ("fakes:limited", "fakes:limited"),
        (fakes.Plane, "fakes:Plane"),
        (fakes.limited, "fakes:limited"),
        (made, "test_sources:made"),
    ],
)
def test_what_has_a_name_can_be_stored_and_made_again(env: Any, reference: str) -> None:
    found = source(env)
    assert found.reference == reference
    again = Source.from_json(json.loads(json.dumps(found.to_json())))
    assert again == found
    assert isinstance(again.make().unwrapped, fakes.Plane)


def test_an_environment_of_gymnasium_make_is_made_again_with_its_arguments() -> None:
    found = source(gymnasium.make("tests/Plane-v0", reward="dense"))
    assert found == Source("tests/Plane-v0", '{"reward": "dense"}')
    assert found.make().unwrapped.reward == "dense"
    assert found.make(max_episode_steps=3).spec.max_episode_steps == 3


@pytest.mark.parametrize("env", [lambda: fakes.limited(), functools.partial(fakes.limited)])
def test_what_has_no_name_is_used_but_not_stored(env: Callable[[], Any]) -> None:
    found = source(env)
    assert isinstance(found.make().unwrapped, fakes.Plane)
    assert describe(env).rule.description.startswith("within 0.5 of the goal")
    with pytest.raises(ConfigurationError, match="cannot be stored in a run folder"):
        found.to_json()


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        (fakes.Plane(), "is one object, and several are needed"),
        (7, "must be a name, a class"),
        ("Nowhere-v0", "unknown environment 'Nowhere-v0'"),
        ("tests/Plane-v9", "unknown environment"),
        ("nowhere:Plane-v0", "there is no module nowhere"),
        ("fakes:Nowhere", "unknown environment 'fakes:Nowhere'"),
    ],
)
def test_what_makes_no_environment_is_refused(env: Any, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason) as raised:
        source(env)
    assert "\n" not in str(raised.value)


def test_what_is_raised_while_it_is_made_becomes_one_line() -> None:
    with pytest.raises(ConfigurationError, match=r"AssertionError: no reason given .fakes.py:\d"):
        source(fakes.broken).make()
    with pytest.raises(ConfigurationError, match=r"must be a gymnasium\.Env"):
        source(lambda: 3).make()
    with pytest.raises(ConfigurationError, match="must be numbers, text and lists"):
        source("tests/Plane-v0", {"reward": object()})


def test_a_module_in_the_working_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_task_module.py").write_text("from fakes import limited as make\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert source("my_task_module:make").make().action_space.shape == (2,)
    (tmp_path / "my_broken_module.py").write_text("1 / 0\n")
    with pytest.raises(ConfigurationError, match="ZeroDivisionError"):
        source("my_broken_module:make")


def test_what_simulators_print_goes_to_standard_error() -> None:
    script = (
        "import os; from midway.envs.sources import source, printing_to_stderr\n"
        "with printing_to_stderr(): os.write(1, b'built'); print('python')\n"
        "print('answer')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout == "answer\n"
    assert "built" in done.stderr
    assert "python" in done.stderr


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(packages.PACKAGES, "not_installed_here", "Wonder")
    with pytest.raises(UnknownEnvironmentError, match="pip install not-installed-here"):
        source("WonderReach-v1")


def test_refusals_name_what_to_give() -> None:
    with pytest.raises(ConfigurationError, match="no limit of steps: give --max-episode-steps N"):
        describe(fakes.Plane)
    assert describe(fakes.Plane, Settings(max_episode_steps=9)).spec.max_episode_steps == 9
    with pytest.raises(ConfigurationError, match="must be at least 1"):
        describe(fakes.Plane, Settings(max_episode_steps=0))
    with pytest.raises(ConfigurationError, match=r"no goal environment.*not Box"):
        describe("Pendulum-v1")
