"""Datasets of others: read as the environment shows them, and learned from without a step."""

from pathlib import Path
from typing import Any

import fakes
import numpy as np
import pytest

import midway
import tiny
from midway.envs.datasets import trajectories
from midway.envs.describing import Settings, describe
from midway.errors import ConfigurationError
from midway.replay import buffer
from midway.training import demonstrations

minari = pytest.importorskip("minari")
pytestmark = pytest.mark.filterwarnings("ignore")

NAME = "tests/plane-v0"
TINY = tiny.TINY | {"num_envs": 2, "random_steps": 20, "checkpoint_every": 60}


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Collect five episodes with Minari's own collector; return what was seen."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    env = minari.DataCollector(fakes.limited(ends="cliff"))
    rng, seen = np.random.default_rng(0), []
    for seed in range(5):
        shown, _ = env.reset(seed=seed)
        episode: dict[str, Any] = {"place": [shown["achieved_goal"]], "action": []}
        over = False
        while not over:
            action = rng.uniform(-1, 1, 2).astype(np.float32)
            shown, _, terminated, truncated, _ = env.step(action)
            episode["place"].append(shown["achieved_goal"])
            episode["action"].append(action)
            over = terminated or truncated
        seen.append(episode | {"goal": shown["desired_goal"], "fell": terminated})
    env.create_dataset(NAME)
    env.close()
    return seen


def test_trajectories_are_what_was_recorded(recorded: list[dict[str, Any]]) -> None:
    found = list(trajectories(NAME, describe(fakes.limited)))
    assert len(found) == len(recorded) == 5
    assert any(episode["fell"] for episode in recorded)
    for each, episode in zip(found, recorded, strict=True):
        np.testing.assert_allclose(each.observations["achieved_goal"], episode["place"], rtol=1e-6)
        np.testing.assert_allclose(
            each.observations["observation"][:, :2], episode["place"], rtol=1e-6
        )
        np.testing.assert_allclose(each.actions, episode["action"], atol=1e-6)
        np.testing.assert_allclose(each.observations["desired_goal"][0], episode["goal"], rtol=1e-6)
        there = np.linalg.norm(episode["place"][-1] - episode["goal"]) < fakes.RADIUS
        assert each.observations["failed"][-1] == (episode["fell"] and not there)
        assert not each.observations["failed"][:-1].any()


def test_long_episodes_are_cut_at_the_limit(recorded: list[dict[str, Any]]) -> None:
    short = describe(fakes.limited, Settings(max_episode_steps=6))
    found = list(trajectories(NAME, short))
    assert max(len(each.actions) for each in found) == 6
    assert sum(len(each.actions) for each in found) == sum(len(e["action"]) for e in recorded)


def test_the_replay_holds_every_step(recorded: list[dict[str, Any]]) -> None:
    foreign = describe(fakes.limited)
    found = list(trajectories(NAME, foreign))
    replay = buffer.create(foreign.spec, 400, 2)
    replay, count = demonstrations.fill(replay, foreign.spec, 2, found)
    assert count == int(buffer.num_transitions(replay)) == sum(len(each.actions) for each in found)


def test_learning_without_a_step_of_ones_own(
    recorded: list[dict[str, Any]], tmp_path: Path
) -> None:
    options = {"agent": "sac", "steps": 60, "data": NAME, "changes": TINY | {"collect": False}}
    run = midway.train(fakes.limited, out=tmp_path / "run", **options)
    assert run.finished
    assert midway.resume(run.path, steps=120).finished
    header, *rows = (run.path / "metrics.csv").read_text().splitlines()
    assert rows
    assert "critic/loss" in header


def test_what_is_no_dataset_of_the_environment_is_refused(
    recorded: list[dict[str, Any]], tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match="--data tests/none-v0: cannot be read"):
        list(trajectories("tests/none-v0", describe(fakes.limited)))
    with pytest.raises(ConfigurationError, match=r"its observation is \(4,\), but .* has \(2,\)"):
        list(trajectories(NAME, describe(fakes.Hidden)))
    with pytest.raises(ConfigurationError, match="not for midway's own"):
        midway.train("point-u", data=NAME, out=tmp_path / "run")
    with pytest.raises(ConfigurationError, match="nothing to learn from"):
        midway.train("point-u", changes={"collect": False}, out=tmp_path / "run")
