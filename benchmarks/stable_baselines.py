"""Train SAC with hindsight replay of Stable-Baselines3 on the environments of others.

    pip install torch stable-baselines3 'midway[robotics]'
    python benchmarks/stable_baselines.py PandaReach-v3 --seed 0

The budget, the evaluations and what counts as reached are those of ``benchmarks/run.py robotics``:
the same environment steps, as many episodes with the deterministic policy, success where the
environment's own info says so at any step. Its hyperparameters are those of
Stable-Baselines3, with midway's layers and learning rate. The rows of a run go to
``benchmarks/results/robotics/ENV-sb3-seedN/evaluation.csv``.
"""

import argparse
import csv
import importlib.metadata
import json
import shlex
import sys
import time

import gymnasium
import gymnasium_robotics
import numpy as np
import panda_gym
from run import RESULTS, ROBOTICS
from stable_baselines3 import SAC, HerReplayBuffer

from midway.envs import packages

PACKAGES = (gymnasium_robotics, panda_gym)
"""They register their environments when they are imported."""

EVERY = 4_000
"""Environment steps from evaluation to evaluation."""

EPISODES = 50
COLUMNS = ("step", "seconds", "training_seconds", "task", "actions", "success_rate", "episodes")
PARTS = ("stable-baselines3", "torch", "gymnasium", "gymnasium-robotics", "panda-gym")


def main() -> None:
    """Train one seed in one environment, and write a row for each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env", choices=ROBOTICS)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    packages.fit_to_mujoco()
    folder = RESULTS / "robotics" / f"{arguments.env}-sb3-seed{arguments.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    config = {
        "env": arguments.env,
        "agent": "sac of Stable-Baselines3",
        "hyperparameters": {"precision": "f32"},
        "seed": arguments.seed,
        "versions": {name: importlib.metadata.version(name) for name in PARTS},
        "command": shlex.join(["python", "benchmarks/stable_baselines.py", *sys.argv[1:]]),
    }
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    with (folder / "evaluation.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for row in train(arguments.env, arguments.seed):
            writer.writerow(row)
            file.flush()


def train(env: str, seed: int):
    """Yield step, seconds, seconds of training, success rate and episodes of each evaluation."""
    model = SAC(
        "MultiInputPolicy",
        gymnasium.make(env),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [256, 256]},
        learning_rate=1e-3,
        learning_starts=1_000,
        seed=seed,
        device="cpu",
    )
    judged, begun, training = gymnasium.make(env), time.perf_counter(), 0.0
    for step in range(EVERY, ROBOTICS[env] + 1, EVERY):
        started = time.perf_counter()
        model.learn(EVERY, reset_num_timesteps=False)
        training += time.perf_counter() - started
        success = np.mean([reached(model, judged, 1_000 * seed + n) for n in range(EPISODES)])
        seconds = time.perf_counter() - begun
        times = round(seconds, 1), round(training, 1)
        yield step, *times, "uniform", "mean", round(float(success), 4), EPISODES


def reached(model: SAC, env: gymnasium.Env, seed: int) -> bool:
    """Return whether the deterministic policy reaches the goal of one episode."""
    observation, _ = env.reset(seed=seed)
    ended = success = False
    while not (ended or success):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
        success = bool(info.get("is_success", info.get("success")))
    return success


if __name__ == "__main__":
    main()
