"""The stage before training: states, networks on disk, reuse; and agents that remember, whole."""

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from safetensors.numpy import load_file

import midway
from midway import api, presets
from midway.agent import PretrainSettings
from midway.agents import leap, tdm
from midway.envs.registry import ENVIRONMENTS
from midway.errors import ConfigurationError, NonFiniteError
from midway.runs.folder import RunFolder
from midway.training import pretrain, state
from midway.training.evaluate import rollout
from midway.types import DistanceTask

TINY: dict[str, Any] = {
    "hidden": (8, 8),
    "batch_size": 16,
    "num_envs": 4,
    "random_steps": 40,
    "updates_per_step": 0.5,
    "replay_capacity": 2_000,
    "evaluate_every": 200,
    "evaluation_episodes": 2,
    "log_every": 100,
    "checkpoint_every": 100,
    "steps": 200,
    "num_subgoals": 3,
    "vae_states": 300,
    "vae_rounds": 3,
    "vae_updates": 10,
    "plan_samples": 16,
    "plan_iterations": 2,
}
TDM = {name: value for name, value in TINY.items() if name in vars(tdm.Config())} | {
    name: TINY[name] for name in TINY if not name.startswith(("vae", "plan", "num_subgoals"))
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    path = tmp_path_factory.mktemp("leap") / "run"
    assert midway.train("point-u", agent="leap", seed=5, out=path, changes=TINY).finished
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def same_numbers(first: Path, second: Path, without: tuple[str, ...]) -> bool:
    pairs = zip(rows(first), rows(second), strict=True)
    return all(
        {k: a[k] for k in a if k not in without} == {k: b[k] for k in b if k not in without}
        for a, b in pairs
    )


# --- states ---------------------------------------------------------------------------------------


def test_states_are_those_of_resets_and_of_random_steps() -> None:
    env = midway.make_vec("point-u", num_envs=50)
    at_rest = pretrain.sample_states(env, PretrainSettings(("vae",), 120, 0, 1), 1)
    assert at_rest.observation.shape == at_rest.achieved_goal.shape == (120, 4)
    np.testing.assert_array_equal(at_rest.observation[:, 2:], 0)
    moved = pretrain.sample_states(env, PretrainSettings(("vae",), 200, 1, 1), 1)
    speeds = np.abs(np.asarray(moved.observation)[:, 2:]).sum(1)
    np.testing.assert_array_equal(speeds[:50], 0)  # resets and steps take turns
    assert (speeds[50:100] > 0).mean() > 0.9
    np.testing.assert_array_equal(speeds[100:150], 0)
    assert len(np.unique(moved.observation, axis=0)) == 200
    assert env.maze.free(np.asarray(at_rest.observation)[:, :2]).all()


def test_same_seed_same_states() -> None:
    env = midway.make_vec("point-u", num_envs=20)
    settings = PretrainSettings(("vae",), 60, 2, 1)
    first, again, other = (pretrain.sample_states(env, settings, s).observation for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


# --- what is written and read ---------------------------------------------------------------------


def test_losses_and_networks_are_written(run: Path) -> None:
    table = rows(run / "pretraining.csv")
    assert [row["step"] for row in table] == ["1", "2", "3"]
    assert float(table[-1]["vae/loss"]) < float(table[0]["vae/loss"])
    arrays = load_file(run / "pretrained.safetensors")
    assert {name.split(".")[0] for name in arrays} == {"vae"}
    saved = load_file(run / "policy.safetensors")
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, saved[name])  # training leaves it alone


def test_the_autoencoder_of_another_run_can_be_taken(run: Path, tmp_path: Path) -> None:
    changes = TINY | {"vae_source": str(run)}
    other = midway.train("point-u", agent="leap", seed=6, out=tmp_path / "run", changes=changes)
    first, second = (load_file(p / "pretrained.safetensors") for p in (run, other.path))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not (other.path / "pretraining.csv").exists()


def test_a_source_that_does_not_fit_is_refused(run: Path, tmp_path: Path) -> None:
    changes = TINY | {"vae_source": str(tmp_path)}
    with pytest.raises(ConfigurationError, match="cannot be read"):
        midway.train("point-u", agent="leap", out=tmp_path / "missing", changes=changes)
    changes = TINY | {"vae_source": str(run), "latent_size": 3}
    with pytest.raises(ConfigurationError, match=r"vae\.encoder"):
        midway.train("point-u", agent="leap", out=tmp_path / "other-size", changes=changes)


def test_agents_without_the_stage_are_left_as_they_are(tmp_path: Path) -> None:
    changes = {name: value for name, value in TDM.items() if name != "max_steps_left"}
    config = api.configure("point-u", "sac", changes=changes)
    said: list[str] = []
    training = state.start(api.setup_of(config, RunFolder(tmp_path)), said.append)
    assert training.counters.seconds == 0
    assert said == []
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_about_to_be_restored_leaves_pretraining_out(tmp_path: Path) -> None:
    setup = api.setup_of(api.configure("point-u", "leap", changes=TINY), RunFolder(tmp_path))
    state.start(setup)
    assert list(tmp_path.iterdir()) == []


def test_a_loss_that_is_not_finite_ends_the_stage(tmp_path: Path) -> None:
    env = midway.make_vec("point-u", num_envs=20)
    config = leap.Config(hidden=(8,), vae_states=100, vae_rounds=4, vae_updates=5)
    start = leap.create(config, env.goal_spec, jax.random.key(0))
    broken = jax.tree.map(lambda x: x * np.nan, start.vae.decoder)
    start = eqx.tree_at(lambda s: s.vae.decoder, start, broken)
    ability = leap.AGENT.pretrain
    assert ability is not None
    with pytest.raises(NonFiniteError, match=r"became nan in round 1 of pre-training"):
        pretrain.run(ability, start, lambda n, t: env, 0, tmp_path, lambda text: None)


# --- what the autoencoder keeps -------------------------------------------------------------------

ROUNDS, STATES = 10, 5_000
"""Of training in tests, fewer than in any preset; `benchmarks/autoencoder.py` measures presets."""

FAST = ("point-u", "ant-u", "push-state")
"""One environment of each family; the others are measured before a release."""


def kept_settings(env: str, preset: str) -> dict[str, Any]:
    """Return what an autoencoder of a preset is made of, but how long it learns."""
    config = vars(api.configure(env, "leap", preset).hyperparameters)
    amounts = ("vae_rounds", "vae_states", "vae_source")
    return {n: v for n, v in config.items() if n.startswith(("vae", "latent")) and n not in amounts}


def held_out_distance(env: str, settings: Mapping[str, Any], tmp_path: Path) -> float:
    """Return how far held-out states are off: the median of the last rounds, which differ."""
    config = leap.Config(hidden=(8,), **settings)
    ability = leap.AGENT.pretrain
    assert ability is not None
    make = partial(midway.make_vec, env)
    start = leap.create(config, make(1).goal_spec, jax.random.key(0))
    pretrain.run(ability, start, lambda n, t: make(n, task=t), 0, tmp_path, lambda text: None)
    last = rows(tmp_path / "pretraining.csv")[-5:]
    return float(np.median([float(row["vae/held_out_distance"]) for row in last]))


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_presets_differ_in_how_long_the_autoencoder_learns_alone(env: str) -> None:
    first, *others = (kept_settings(env, preset) for preset in presets.NAMES)
    assert all(other == first for other in others)


@pytest.mark.parametrize(
    "env",
    [
        pytest.param(name, marks=() if name in FAST else pytest.mark.release)
        for name in ENVIRONMENTS
        if name != "push"
    ],
)
def test_the_autoencoder_keeps_where_things_are(env: str, tmp_path: Path) -> None:
    """A subgoal is worth planning for if it is off by less than what counts as reached."""
    amounts = {"vae_rounds": ROUNDS, "vae_states": STATES}
    found = held_out_distance(env, kept_settings(env, "quick") | amounts, tmp_path)
    task = midway.make_vec(env).goal_spec.task
    assert isinstance(task, DistanceTask)
    assert found < task.threshold


# --- whole runs of agents that remember -----------------------------------------------------------


@pytest.mark.parametrize("agent", ["tdm", "leap"])
def test_interrupted_and_resumed_equals_uninterrupted(agent: str, tmp_path: Path) -> None:
    """What agents remember of running episodes is in the checkpoint."""
    changes = TINY if agent == "leap" else TDM
    whole = midway.train("point-u", agent=agent, seed=5, out=tmp_path / "whole", changes=changes)
    half = {**changes, "steps": 100}
    stopped = midway.train("point-u", agent=agent, seed=5, out=tmp_path / "half", changes=half)
    resumed = midway.resume(stopped.path, steps=200)
    weights = [(r.path / "policy.safetensors").read_bytes() for r in (whole, resumed)]
    assert weights[0] == weights[1]
    times = ("seconds", "training_seconds")
    assert same_numbers(whole.path / "metrics.csv", resumed.path / "metrics.csv", times)


def test_loaded_policies_plan(run: Path) -> None:
    policy = midway.load(run)
    env = midway.make_vec("point-u", num_envs=2)
    observation, _ = env.reset(seed=1)
    pair = observation["observation"], observation["desired_goal"]
    actor = policy.actor()
    # Both plan, with other draws: these networks are hardly trained, their plans are alike.
    np.testing.assert_allclose(actor(*pair), policy(*pair), atol=0.1)
    plan = np.asarray(actor.memory.latents)
    actor(*pair)
    np.testing.assert_array_equal(actor.memory.latents, plan)  # the segment is not over
    assert actor.memory.elapsed.tolist() == [2, 2]
    actor.rest(np.array([True, False]))
    assert actor.memory.elapsed[0] > env.goal_spec.max_episode_steps
    assert actor.memory.elapsed[1] == 2
    assert policy(pair[0][0], pair[1][0]).shape == (2,)


def test_evaluation_plans_and_is_reproducible(run: Path) -> None:
    result = midway.evaluate(run, episodes=3, task="uniform")
    assert result == midway.evaluate(run, episodes=3, task="uniform")
    assert len(result.episodes) == 3


def test_time_is_remembered_until_an_episode_is_over(run: Path) -> None:
    env = midway.make_vec("point-u", num_envs=2, task="hard")
    actor, seen = midway.load(run).actor(), []
    observation, _ = env.reset(seed=0, options={"task": "hard"})
    for moment in rollout(env, actor, observation):
        seen.append(actor.memory.elapsed.tolist())
        running = moment.running
    steps = len(seen)
    assert steps <= env.goal_spec.max_episode_steps
    longest = int(np.flatnonzero(running)[0])
    assert [row[longest] for row in seen] == list(range(1, steps + 1))
