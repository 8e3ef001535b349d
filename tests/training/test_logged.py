"""What collection and evaluation log beyond success: flips, distances with names, the step."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

import tiny
from midway import api
from midway.envs.registry import make_vec
from midway.reports.runs import read
from midway.runs.folder import RunFolder
from midway.training import loop, state
from midway.training.evaluate import run_episodes

TINY = tiny.TINY | {"replay_capacity": 5_000, "evaluate_every": 10_000, "checkpoint_every": 10_000}
ON_ITS_BACK = (0.0, 1.0, 0.0, 0.0)
ON_ITS_SIDE = (np.cos(0.77), np.sin(0.77), 0.0, 0.0)
"""A roll of 88 degrees."""


def overturned(num_envs: int, quaternions: dict[int, tuple[float, ...]]) -> Any:
    """Return an ant environment with some ants turned about x, high above the floor."""
    env = make_vec("ant-u", num_envs=num_envs)
    env.reset(seed=0)
    for copy, quaternion in quaternions.items():
        env.batch.bind("qpos")[copy, 2:7] = (5.0, *quaternion)
    return env


def test_an_ant_on_its_back_is_flipped_and_one_on_its_side_is_not() -> None:
    env = overturned(3, {1: ON_ITS_BACK, 2: ON_ITS_SIDE})
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert info["flipped"].tolist() == [False, True, False]
    assert info["_flipped"].all()


def test_the_share_of_steps_on_its_back_is_logged_and_begins_anew() -> None:
    config = api.configure("ant-u", changes={**TINY, "random_steps": 400})
    training = state.start(api.setup_of(config, RunFolder(Path("unused"))))
    env = training.collector.env
    loop.advance(training)
    env.batch.bind("qpos")[1, 2:7] = (5.0, *ON_ITS_BACK)
    loop.advance(training)
    assert training.collector.take_metrics()["collect/flip_rate"] == 1 / 8
    assert np.isnan(training.collector.take_metrics()["collect/flip_rate"])


def test_flips_are_a_column_of_ants_and_of_nothing_else(
    tmp_path: Path, short_episodes: None
) -> None:
    columns = {}
    for env in ("ant-u", "point-u"):
        run = api.train(env, agent="sac", steps=80, out=tmp_path / env, changes=TINY).path
        with (run / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        columns[env] = set(rows[0])
        assert len(rows) == 2
    assert columns["ant-u"] - columns["point-u"] == {"collect/flip_rate"}
    assert 0 <= float(read(tmp_path / "ant-u").metrics["collect/flip_rate"][-1]) < 0.5


def test_hand_and_puck_are_evaluated_each(tmp_path: Path) -> None:
    env = make_vec("push-state", num_envs=3)
    result = run_episodes(env, lambda o, g: np.zeros((3, 2)), "hard", "mean", seed=0)
    for episode in result.episodes:
        assert episode.final_distance == max(episode.final_distances.values())
        # The boxes of hard are at least this far apart, and nothing has moved.
        assert episode.final_distances["hand"] > 0.3
        assert episode.final_distances["puck"] > 0.25
    assert list(result.final_distances) == ["hand", "puck"]
    run = api.train("push-state", agent="sac", steps=80, out=tmp_path / "run", changes=TINY).path
    table = read(run).evaluation
    larger = np.maximum(table["final_distance_hand"], table["final_distance_puck"])
    assert (table["final_distance"] >= larger - 1e-9).all()


def test_a_policy_knows_its_step(tmp_path: Path) -> None:
    run = api.train("point-u", agent="sac", steps=80, out=tmp_path / "run", changes=TINY).path
    assert api.load(run).step == 80
    assert read(run).policy_step == 80
    description = json.loads((run / "policy.json").read_text())
    assert description.pop("step") == 80
    for name in ("format", "run", "sha256"):  # as earlier versions wrote it
        del description[name]
    (run / "policy.json").write_text(json.dumps({**description, "format": 2}))
    assert api.load(run).step is None
    assert read(run).policy_step == 80
