"""Compare the stepping of environments of others by midway and by an AsyncVectorEnv alone.

    python benchmarks/stepping.py [--json FILE]

Both step the same environments with random actions, and reset those that have ended. midway also
judges success and hands out float32 vectors. Rounds of both alternate; the ratio is the median of
the ratios round by round. Run it with nothing else on the machine.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import gymnasium_robotics
import panda_gym

from midway.bench import pieces
from midway.envs.registry import make_vec

PACKAGES = (gymnasium_robotics, panda_gym)
"""They register their environments when they are imported."""

ENVIRONMENTS = ("PandaReach-v3", "PointMaze_UMaze-v3", "PointMaze_Medium-v3", "FetchReach-v4")
NUM_ENVS = 16
ROUNDS = 9
STEPS = 60
"""Steps of all environments in a round."""


def main() -> None:
    """Print one line for each environment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    rows = [compare(env) for env in ENVIRONMENTS]
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if arguments.json:
        found = {"machine": pieces.machine(), "stepping": rows}
        arguments.json.write_text(json.dumps(found, indent=2) + "\n")


def compare(env: str) -> dict[str, object]:
    """Return medians of both speeds (steps per second) and of the ratio round by round."""
    both = {"midway": ours(env), "async_vector_env": theirs(env)}
    rounds: dict[str, list[float]] = {name: [] for name in both}
    for step in both.values():
        timed(step)  # what starts slowly is not measured
    for _ in range(ROUNDS):
        for name, step in both.items():
            rounds[name].append(timed(step))
    ratio = statistics.median(
        ours / theirs
        for ours, theirs in zip(rounds["midway"], rounds["async_vector_env"], strict=True)
    )
    speeds = {name: round(statistics.median(found)) for name, found in rounds.items()}
    return {"env": env, "num_envs": NUM_ENVS, **speeds, "ratio": round(ratio, 2)}


def timed(step: Callable[[], None]) -> float:
    """Return the environment steps per second of a round."""
    started = time.perf_counter()
    for _ in range(STEPS):
        step()
    return STEPS * NUM_ENVS / (time.perf_counter() - started)


def ours(name: str) -> Callable[[], None]:
    """Return a step of midway's environments, whose resets are asked for."""
    env = make_vec(name, NUM_ENVS)
    env.reset(seed=0)

    def step() -> None:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        ended = terminated | truncated
        if ended.any():
            env.reset(options={"reset_mask": ended})

    return step


def theirs(name: str) -> Callable[[], None]:
    """Return a step of an AsyncVectorEnv, which resets by itself: one process an environment."""
    env = gymnasium.vector.AsyncVectorEnv([lambda: gymnasium.make(name)] * NUM_ENVS)
    env.reset(seed=0)
    return lambda: env.step(env.action_space.sample()) and None


if __name__ == "__main__":
    main()
