"""Environments of others that raise, or show what they did not declare, stop a run by name."""

import csv
import itertools
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import midway
import tiny
from midway.envs.registry import make_vec
from midway.errors import BrokenEnvironmentError
from midway.replay.buffer import create, num_transitions
from midway.training import loop
from midway.training.checkpoint import steps_in
from midway.training.collect import Collector
from midway.training.state import Training

TINY = tiny.TINY | {
    "num_envs": 2,
    "random_steps": 20,
    "replay_capacity": 400,
    "evaluate_every": 1_000,
    "evaluation_episodes": 1,
    "checkpoint_every": 1_000,
    "steps": 80,
}


EVALUATED = 21
"""Steps that making the environments and evaluating the policy at step 0 take."""


class Line(gymnasium.Env[Any, Any]):
    """A point on a line, which breaks between these steps of all of its kind."""

    breaks_after = 10**9
    how = "raise"
    taken = 0
    until = 10**9

    def __init__(self) -> None:
        box = spaces.Box(-10, 10, (1,), np.float64)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(names, box))
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.spec = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x, self.goal = np.zeros(1), self.np_random.uniform(-1, 1, 1)
        return self._shown(), {}

    def step(self, action: Any) -> Any:
        Line.taken += 1
        self.x = np.clip(self.x + 0.2 * np.asarray(action, np.float64), -10, 10)
        if Line.breaks_after < Line.taken <= Line.until:
            if Line.how == "raise":
                raise ValueError("the\nsimulator is tired")
            self.x = np.zeros(3) if Line.how == "shape" else np.array([np.nan])
        return self._shown(), 0.0, False, False, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -1.0 * (np.linalg.norm(achieved - desired, axis=-1) > 0.2)

    def _shown(self) -> dict[str, Any]:
        return {"observation": self.x, "achieved_goal": self.x, "desired_goal": self.goal}


def watch_replay(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that is told how many transitions can be drawn after each step."""
    stored: list[int] = []
    advance = loop.advance

    def and_count(training: Training) -> None:
        advance(training)
        stored.append(int(num_transitions(training.replay)))

    monkeypatch.setattr(loop, "advance", and_count)
    return stored


@pytest.mark.parametrize(
    ("how", "said"),
    [("raise", "ValueError: the"), ("shape", "ValueError"), ("nan", "is not finite")],
)
def test_a_broken_environment_stops_the_run_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str, said: str
) -> None:
    env = midway.goal_env(Line, max_episode_steps=20, success_distance=0.2)
    monkeypatch.setattr(Line, "how", how)
    monkeypatch.setattr(Line, "breaks_after", Line.taken + 51 + EVALUATED)
    stored = watch_replay(monkeypatch)
    with pytest.raises(BrokenEnvironmentError) as error:
        midway.train(env, agent="sac", out=tmp_path / "run", changes=TINY)
    text = str(error.value)
    (breaks_in,) = re.findall(r"in step (\d+) of its episode", text)
    assert stored[-1] == 50 - (int(breaks_in) - 1)  # nothing of the episode that broke
    assert said in text
    assert "environment 1" in text
    assert "action [" in text
    assert "midway resume" in text
    assert max(steps_in(tmp_path / "run" / "checkpoints")) == 50


@pytest.mark.parametrize("how", ["raise", "nan"])
def test_a_broken_environment_is_made_anew_where_the_run_shall_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    env = midway.goal_env(Line, max_episode_steps=20, success_distance=0.2)
    monkeypatch.setattr(Line, "how", how)
    monkeypatch.setattr(Line, "breaks_after", Line.taken + 31)
    monkeypatch.setattr(Line, "until", Line.taken + 33)
    stored = watch_replay(monkeypatch)
    run = midway.train(env, agent="sac", out=tmp_path, changes=TINY, on_env_error="restart")
    assert run.finished
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert sum(float(row["collect/restarts"]) for row in rows) == 2
    assert any(after < before for before, after in itertools.pairwise(stored))


def test_an_environment_that_always_breaks_stops_the_run_after_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = midway.goal_env(Line, max_episode_steps=20, success_distance=0.2)
    monkeypatch.setattr(Line, "breaks_after", Line.taken + 31)
    with pytest.raises(BrokenEnvironmentError, match="simulator is tired"):
        midway.train(env, agent="sac", out=tmp_path, changes=TINY, on_env_error="restart")


def test_where_a_reset_ends_all_episodes_all_begin_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that hangs in a process of its own does."""
    env = make_vec("point-u", 2)
    replay = create(env.goal_spec, 1_000, 2)
    collector, replay = Collector.start(env, replay, seed=0, restarts=True)
    replay = collector.step(replay, lambda observation: np.zeros((2, 2), np.float32))
    with monkeypatch.context() as patch:

        def once(**given: Any) -> Any:
            patch.undo()
            lost = BrokenEnvironmentError("no answer")
            lost.copies = range(2)
            raise lost

        patch.setattr(env, "reset", once)
        collector.begun = np.array([True, False])
        replay = collector._begin(replay)
    assert collector.begun.all()
    assert np.asarray(replay.num_episodes).tolist() == [2, 2]
    assert collector.counts.restarts == 1
