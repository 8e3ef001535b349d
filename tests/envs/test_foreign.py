"""A goal environment that is not ours, by its own id."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces

import midway
from midway.errors import ConfigurationError

TINY = {
    "hidden": (8,),
    "batch_size": 8,
    "num_envs": 2,
    "random_steps": 20,
    "replay_capacity": 500,
    "evaluate_every": 60,
    "evaluation_episodes": 2,
    "log_every": 20,
    "checkpoint_every": 60,
}


class Reach(gymnasium.Env[dict[str, Any], Any]):
    """A hand on a line whose goal is its place alone; actions are in [0, 4]."""

    def __init__(self) -> None:
        box = spaces.Box(-10.0, 10.0, (2,), np.float64)
        place = spaces.Box(-10.0, 10.0, (1,), np.float64)
        self.observation_space = spaces.Dict(
            {"observation": box, "achieved_goal": place, "desired_goal": place}
        )
        self.action_space = spaces.Box(0.0, 4.0, (1,), np.float32)
        self.state = np.zeros(2)
        self.goal = np.zeros(1)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 2)
        self.goal = self.np_random.uniform(3, 4, 1)
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.state = np.array([self.state[0] + (action[0] - 2) / 2, action[0]])
        observation = self.observe()
        reward = self.compute_reward(observation["achieved_goal"], self.goal, {})
        return observation, reward, False, False, {}

    def observe(self) -> dict[str, Any]:
        return {
            "observation": self.state,
            "achieved_goal": self.state[:1],
            "desired_goal": self.goal,
        }

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> float:
        return 0.0 if abs(achieved[0] - desired[0]) < 0.3 else -1.0


@pytest.fixture(autouse=True)
def reach() -> Iterator[None]:
    gymnasium.register("tests/Reach-v0", Reach, max_episode_steps=20)
    yield
    gymnasium.registry.pop("tests/Reach-v0")


def test_actions_are_scaled_and_reward_is_minus_one_until_the_goal() -> None:
    env = midway.make_vec("tests/Reach-v0", num_envs=2)
    observation, _ = env.reset(seed=0)
    start = observation["achieved_goal"].copy()
    observation, reward, terminated, _, _ = env.step(np.array([[1.0], [-1.0]], np.float32))
    moved = observation["achieved_goal"] - start
    np.testing.assert_allclose(moved, [[1.0], [-1.0]], rtol=1e-5)
    assert reward.tolist() == [-1.0, -1.0]
    for _ in range(19):
        observation, reward, terminated, truncated, info = env.step(np.full((2, 1), 0.4, "float32"))
        distance = np.abs(observation["achieved_goal"] - observation["desired_goal"])[:, 0]
        assert (terminated == (distance < 0.3)).all()
        np.testing.assert_allclose(info["distance"], distance, rtol=1e-5)
        ended = terminated | truncated
        if ended.any():
            env.reset(options={"reset_mask": ended})


def test_task_gives_the_same_inside_a_compiled_step() -> None:
    task = midway.make_vec("tests/Reach-v0").goal_spec.task
    achieved = np.linspace(0, 1, 9, dtype=np.float32)[:, None]
    desired = np.full((9, 1), 0.5, np.float32)
    reward, terminated = jax.jit(task)(achieved, desired)
    assert (np.asarray(terminated) == task(achieved, desired)[1]).all()
    assert np.asarray(terminated).sum() == 5
    assert (np.asarray(reward) == -1).all()


@pytest.mark.parametrize("agent", ["ris", "sac"])
def test_train_resume_and_evaluate(tmp_path: Path, agent: str) -> None:
    """RIS predicts pairs of observation and achieved goal here, of sizes 2 and 1."""
    run = midway.train("tests/Reach-v0", agent=agent, steps=60, out=tmp_path / "run", changes=TINY)
    assert run.finished
    assert midway.resume(run.path, steps=120).finished
    result = midway.evaluate(run.path, episodes=3, task="uniform")
    assert len(result.episodes) == 3
    action = midway.load(run.path)(np.zeros(2, np.float32), np.zeros(1, np.float32))
    assert action.shape == (1,)


def test_what_is_no_goal_environment_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no goal environment"):
        midway.make_vec("Pendulum-v1")
    with pytest.raises(ConfigurationError, match="unknown environment"):
        midway.make_vec("Nowhere-v0")
