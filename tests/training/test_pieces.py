"""The parts of the training loop, each by itself."""

import csv
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from midway import api, presets
from midway.agents.registry import AGENTS
from midway.envs.push import STATE_SPEC
from midway.envs.registry import ENVIRONMENTS, make_vec
from midway.errors import ConfigurationError
from midway.runs.folder import RunConfig, RunFolder
from midway.tables import Appender
from midway.training import loop, progress, state
from midway.training.arrays import named_arrays, with_named_arrays
from midway.training.config import TrainConfig
from midway.training.evaluate import run_episodes

TINY = {"hidden": (8,), "batch_size": 8, "num_envs": 4, "replay_capacity": 2_000}


@given(
    num_envs=st.integers(1, 20),
    ratio=st.sampled_from([0.1, 0.25, 1 / 3, 0.5, 1.0, 1.5, 2.0]),
    turns=st.integers(1, 400),
)
def test_updates_follow_the_ratio_whatever_the_number_of_environments(
    num_envs: int, ratio: float, turns: int
) -> None:
    config = TrainConfig(num_envs=num_envs, updates_per_step=ratio, random_steps=40)
    done, per_call = 0, config.updates_per_call(encoding=False)
    for turn in range(1, turns + 1):
        while config.updates_due(turn * num_envs, STATE_SPEC) - done >= per_call:
            done += per_call
    exact = max(0, turns * num_envs - 40) * ratio
    assert exact - per_call - 1e-6 < done <= exact + 1e-6


@pytest.mark.parametrize("name", ["steps", "num_envs", "batch_size", "updates_per_step"])
def test_settings_must_be_positive(name: str) -> None:
    with pytest.raises(ConfigurationError, match=name):
        TrainConfig(**{name: 0.0 if name == "updates_per_step" else 0})


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("preset", ["paper", "quick"])
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_every_preset_survives_its_file(agent: str, preset: str, env: str) -> None:
    config = RunConfig(env, agent, preset, 3, *presets.resolve(env, agent, preset)[:2])
    assert RunConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_paper_preset_is_table_1() -> None:
    train, ris = presets.resolve("ant-u", "ris", "paper")[:2]
    assert (train.batch_size, train.updates_per_step, train.replay_capacity) == (2048, 1, 10**6)
    assert (ris.discount, ris.target_update_rate, ris.epsilon) == (0.99, 5e-3, 1e-16)
    rates = (ris.critic_learning_rate, ris.policy_learning_rate, ris.subgoal_learning_rate)
    assert rates == (1e-3, 1e-3, 1e-4)
    assert (ris.kl_weight, ris.advantage_temperature, ris.num_subgoals) == (0.1, 0.1, 10)


def test_paper_preset_of_the_arm_is_the_other_column_of_table_1() -> None:
    train, ris = presets.resolve("push", "ris", "paper")[:2]
    assert (train.batch_size, train.updates_per_step) == (256, 1)
    assert 100_000 <= train.replay_capacity * 100 / 102 < 101_000
    rates = (ris.critic_learning_rate, ris.policy_learning_rate, ris.subgoal_learning_rate)
    assert rates == (1e-3, 1e-4, 1e-4)
    assert (ris.epsilon, ris.encoder_learning_rate) == (1e-4, 1e-4)
    assert presets.resolve("push", "sac", "paper").hyperparameters.policy_learning_rate == 1e-4


def test_changes_take_text_and_keep_types() -> None:
    changes = {"batch_size": "32", "relabel": "(0.5, 0.25, 0.25)", "kl_weight": "1", "steps": 2e3}
    config = api.configure("point-u", changes=changes)
    assert config.train.batch_size == 32
    assert config.train.relabel.own == 0.5
    assert config.hyperparameters.kl_weight == 1.0
    assert config.train.steps == 2_000
    assert isinstance(config.train.steps, int)


def test_table_keeps_rows_up_to_a_step_and_drops_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = Appender(path, until=0)
    for step in (10, 20, 30):
        table.write({"step": step, "loss": step / 2, "note": ""})
    with path.open("a") as file:
        file.write("4")
    Appender(path, until=20).write({"step": 25, "loss": 1.0, "later": "not a column"})
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["step", "loss", "note"],
        ["10", "5.0", ""],
        ["20", "10.0", ""],
        ["25", "1.0", ""],
    ]


def test_arrays_by_name_come_back_or_are_refused() -> None:
    tree = {"a": [np.ones(2, np.float32), np.zeros((1, 3), np.int32)]}
    arrays = named_arrays(tree)
    assert set(arrays) == {"a.0", "a.1"}
    back = with_named_arrays(tree, {name: array + 1 for name, array in arrays.items()})
    assert back["a"][0].tolist() == [2.0, 2.0]
    for broken in ({}, {**arrays, "a.0": np.ones(3, np.float32)}, {**arrays, "a.0": np.ones(2)}):
        with pytest.raises(ConfigurationError, match=r"a\.0"):
            with_named_arrays(tree, broken)


def test_training_compiles_once_and_moves_nothing_to_the_host(tmp_path: Path) -> None:
    """A call of several updates transfers nothing; a run traces sampling and update once."""
    config = api.configure("point-u", "ris", changes={**TINY, "random_steps": 40})
    training = state.start(api.setup_of(config, RunFolder(tmp_path)))
    while training.counters.updates < 40:
        loop.advance(training)
    assert training.program.train._cache_size() == 1  # type: ignore[attr-defined]
    key, updates = jax.random.key(0), jax.numpy.asarray(0)
    arguments = (training.arrays, training.totals, training.replay, key, updates)
    compiled = jax.jit(training.program.train).lower(*arguments).compile()
    with jax.transfer_guard("disallow"):
        jax.block_until_ready(compiled(*arguments))


class Line:
    """One-dimensional walk for evaluation: each starts as far away as its number says."""

    tasks = ("near",)
    goal_spec, resumable, logged_info = None, False, {}

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.left = np.zeros(num_envs)
        self.elapsed = np.zeros(num_envs, int)

    def reset(self, *, seed: Any = None, options: Any) -> Any:
        mask = options.get("reset_mask", np.ones(self.num_envs, bool))
        self.left[mask] = np.arange(1, self.num_envs + 1)[mask]
        self.elapsed[mask] = 0
        return self.observe(), {}

    def state_dict(self) -> Any:
        return {}

    def load_state_dict(self, state: Any) -> None:
        pass

    def observe(self) -> Any:
        return {
            "observation": self.left[:, None].copy(),
            "desired_goal": np.zeros((self.num_envs, 1)),
        }

    def step(self, actions: Any) -> Any:
        self.left -= 1
        self.elapsed += 1
        info = {"elapsed_steps": self.elapsed.copy(), "distance": self.left.copy()}
        info["is_success"] = self.left <= 0
        return self.observe(), None, self.left <= 0, self.elapsed >= 3, info

    def rest(self, mask: Any) -> Any:
        return self.reset(options={"reset_mask": mask})[0]

    def ways(self) -> Any:
        return np.ones(self.num_envs)


def test_evaluation_records_the_first_episode_of_every_environment() -> None:
    result = run_episodes(Line(5), lambda o, g: np.zeros((5, 1)), "near", "mean", seed=0)
    assert [e.success for e in result.episodes] == [True, True, True, False, False]
    assert [e.length for e in result.episodes] == [1, 2, 3, 3, 3]
    assert [e.final_distance for e in result.episodes] == [0, 0, 0, 1, 2]
    assert result.success_rate == 0.6


def test_progress_is_plain_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say = progress.reporter(100, 0)
    say.advance(50, {"steps/s": 12.345, "success/hard": 0.5})
    say.message("done")
    say.close()
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "step 50/100  steps/s 12.35  success/hard 0.5\ndone\n"


def test_bar_shows_the_same_on_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    bar = progress.Bar(100, 0)
    bar.advance(50, {"steps/s": 12.345})
    bar.message("said [x]")
    bar.close()
    err = capsys.readouterr().err
    assert "said [x]" in err
    assert "50/100" in err
    assert "12.35" in err


def test_collected_episodes_are_counted() -> None:
    env = make_vec("point-u", num_envs=2)
    config = api.configure("point-u", changes={**TINY, "num_envs": 2, "random_steps": 400})
    training = state.start(api.setup_of(config, RunFolder(Path("unused"))))
    while training.counters.steps < 310:
        loop.advance(training)
    counts = training.collector.counts
    assert env.goal_spec.max_episode_steps == 150
    assert counts.episodes >= 2
    assert counts.metrics()["collect/episode_length"] <= 150
    assert counts.length <= training.counters.steps
