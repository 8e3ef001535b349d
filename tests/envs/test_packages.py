"""Environments of known packages: success is what they say themselves, in a loop without midway."""

import importlib
import json
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.seeding import np_random

import midway
import tiny
from midway.cli.main import main
from midway.envs.describing import Foreign, Settings, describe
from midway.envs.foreign import ForeignVectorEnv
from midway.envs.success import AskedRule, DistanceRule
from midway.errors import ConfigurationError

pytestmark = pytest.mark.filterwarnings("ignore")

EPISODES = 3
TINY = tiny.TINY | {
    "num_envs": 2,
    "random_steps": 20,
    "evaluation_episodes": 1,
    "checkpoint_every": 60,
}
CASES = {
    # id: (package, limit, gain of the push towards the goal, distance that is success)
    "PointMaze_UMaze-v3": ("gymnasium_robotics", 150, 5.0, 0.45),
    "PointMaze_Open-v3": ("gymnasium_robotics", 100, 5.0, 0.45),
    "AntMaze_UMaze-v5": ("gymnasium_robotics", 15, 0.0, 0.45),
    "FetchReach-v4": ("gymnasium_robotics", 50, 10.0, 0.05),
    "FetchPush-v4": ("gymnasium_robotics", 15, 10.0, 0.05),
    "PandaReach-v3": ("panda_gym", 50, 10.0, 0.05),
    "parking-v0": ("highway_env", 40, 0.0, None),
}
SURE = ("PointMaze_Open-v3", "FetchReach-v4", "PandaReach-v3")
"""Where pushing straight towards the goal reaches some."""


def described(gym_id: str) -> Foreign:
    package, limit, _, _ = CASES[gym_id]
    pytest.importorskip(package, exc_type=ImportError)
    return describe(gym_id, Settings(max_episode_steps=limit))


def push(observation: Any, gain: float, dims: int, rng: np.random.Generator) -> Any:
    """Return an action towards the goal, with noise."""
    towards = np.zeros(dims)
    wanted = gain * (observation["desired_goal"] - observation["achieved_goal"])
    towards[: min(dims, len(wanted))] = wanted[:dims]
    return np.clip(towards + rng.uniform(-1, 1, dims), -1, 1).astype(np.float32)


def plain_episode(gym_id: str, seed: int, noise: int) -> tuple[bool, int, bool]:
    """Return success, length and crash of an episode in a loop that midway has no part in."""
    package, limit, gain, _ = CASES[gym_id]
    importlib.import_module(package)
    env = gymnasium.make(gym_id, max_episode_steps=limit, disable_env_checker=True)
    rng = np.random.default_rng(noise)
    observation, _ = env.reset(seed=seed)
    dims = env.action_space.shape[0]
    length, success = 0, False
    while length < limit:
        length += 1
        action = push(observation, gain, dims, rng)
        low, high = env.action_space.low, env.action_space.high
        scaled = low + (action + 1) / 2 * (high - low)
        observation, _, terminated, truncated, info = env.step(scaled.astype(np.float32))
        success = bool(info.get("is_success", info.get("success")))
        if success or terminated or truncated:
            break
    env.close()
    return success, length, bool(terminated and not success)


@pytest.mark.parametrize("gym_id", CASES)
def test_success_is_what_the_environment_says_itself(gym_id: str) -> None:
    foreign = described(gym_id)
    gain = CASES[gym_id][2]
    env = ForeignVectorEnv(foreign, EPISODES, num_threads=1)
    env.reset(seed=10)
    noises = [np.random.default_rng(copy) for copy in range(EPISODES)]
    mine: dict[int, tuple[bool, int, bool]] = {}
    while len(mine) < EPISODES:
        exact = env._held
        actions = np.stack(
            [
                push({k: v[copy] for k, v in exact.items()}, gain, foreign.spec.action_dim, noise)
                for copy, noise in enumerate(noises)
            ]
        )
        _, _, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        for copy in np.flatnonzero(ended):
            length = int(info["elapsed_steps"][copy])
            mine.setdefault(
                int(copy), (bool(info["is_success"][copy]), length, bool(info["failed"][copy]))
            )
        if ended.any():
            env.reset(options={"reset_mask": ended})
    env.close()
    seeds = [int(np_random(10 + copy)[0].integers(2**31)) for copy in range(EPISODES)]
    theirs = {copy: plain_episode(gym_id, seed, copy) for copy, seed in enumerate(seeds)}
    assert mine == theirs
    if gym_id in SURE:
        assert any(success for success, _, _ in theirs.values())


@pytest.mark.parametrize("gym_id", CASES)
def test_goals_of_hindsight_are_judged_as_the_environment_does(gym_id: str) -> None:
    foreign = described(gym_id)
    radius = CASES[gym_id][3]
    assert isinstance(foreign.rule, AskedRule if radius is None else DistanceRule)
    if isinstance(foreign.rule, DistanceRule):
        assert foreign.rule.threshold == pytest.approx(radius, rel=1e-6)
    rng = np.random.default_rng(0)
    env = foreign.source.make()
    observation, _ = env.reset(seed=0)
    goal = np.asarray(observation["desired_goal"], np.float32)
    scale = 0.3 if radius is None else radius
    achieved = (goal + scale * rng.normal(size=(64, len(goal)))).astype(np.float32)
    desired = np.tile(goal, (64, 1))
    raw: Any = env.unwrapped
    if gym_id == "parking-v0":
        truth = [bool(raw._is_success(a, d)) for a, d in zip(achieved, desired, strict=True)]
    else:
        at_goal = float(raw.compute_reward(goal, goal, {}))
        rewards = [
            float(raw.compute_reward(a, d, {})) for a, d in zip(achieved, desired, strict=True)
        ]
        truth = [reward == at_goal for reward in rewards]
    assert foreign.rule(achieved, desired)[1].tolist() == truth
    assert np.asarray(jax.jit(foreign.rule)(achieved, desired)[1]).tolist() == truth
    assert any(foreign.rule(desired, desired)[1])


def test_parking_says_what_to_give() -> None:
    pytest.importorskip("highway_env")
    with pytest.raises(ConfigurationError, match="give --max-episode-steps N"):
        describe("parking-v0")


@pytest.mark.parametrize("gym_id", ["PointMaze_UMaze-v3", "FetchReach-v4", "parking-v0"])
def test_a_run_made_from_python_goes_on_from_the_command_line(
    gym_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Success is never claimed away from the goal, and no episode ends before it has begun."""
    foreign, radius = described(gym_id), CASES[gym_id][3]
    env = midway.goal_env(gym_id, max_episode_steps=foreign.spec.max_episode_steps)
    run = midway.train(env, agent="sac", steps=60, out=tmp_path / "run", changes=TINY).path
    main(["resume", str(run), "--steps", "120"])
    capsys.readouterr()
    main(["evaluate", str(run), "--episodes", "4", "--json"])
    for episode in json.loads(capsys.readouterr().out)["episodes"]:
        assert episode["success"] or episode["length"] > 1
        if radius is not None:
            assert episode["success"] == (episode["final_distance"] < radius)
