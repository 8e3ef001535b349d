"""Compare SAC with hindsight replay against Stable-Baselines3, in one process, update by update.

    pip install torch stable-baselines3
    python benchmarks/speed.py [--json FILE]

Both take ant-u's sizes, two hidden layers of 256 and the same batch, and both sample and relabel
within the timed call, which makes as many updates as follow a step of eight environments. Rounds
of both alternate, so that a machine that drifts slows both alike; a pause before each round lets
the threads of the other one fall asleep, which wait busily for a while. Medians of times for one
update, and of the ratios round by round, are printed. Run it with nothing else on the machine.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import torch
from stable_baselines3 import SAC, HerReplayBuffer

from midway.bench import pieces as bench

BATCHES = (256, 2048)
UPDATES = 8
"""Updates in a call."""

ROUNDS = 8
CALLS = 5
"""Calls of each in a round; the first is not counted."""

PAUSE = 0.5
"""Seconds of sleep before a round."""

STEPS = 20_000
"""Random steps in each replay before anything is timed."""


def main() -> None:
    """Print one line for each batch size and precision."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    rows = [compare(batch, precision) for batch in BATCHES for precision in ("f32", "bf16")]
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if arguments.json:
        machine = {
            **bench.machine(),
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
        }
        arguments.json.write_text(json.dumps({"machine": machine, "sac": rows}, indent=2) + "\n")


def compare(batch: int, precision: str) -> dict[str, Any]:
    """Return medians of both updates in milliseconds and of the ratio pair by pair."""
    pieces = {"midway": ours(batch, precision), "stable_baselines3": theirs(batch)}
    rounds: dict[str, list[float]] = {name: [] for name in pieces}
    for _ in range(ROUNDS):
        for name, piece in pieces.items():
            rounds[name].append(one_round(piece))
    pairs = zip(rounds["stable_baselines3"], rounds["midway"], strict=True)
    speedup = statistics.median(theirs / ours for theirs, ours in pairs)
    figures = {f"{name}_ms": round(statistics.median(t), 2) for name, t in rounds.items()}
    return {"batch": batch, "precision": precision, **figures, "speedup": round(speedup, 2)}


def one_round(piece: Callable[[], None]) -> float:
    """Return the median time of one update in milliseconds."""
    time.sleep(PAUSE)
    times = []
    for _ in range(CALLS):
        started = time.perf_counter()
        piece()
        times.append(1e3 * (time.perf_counter() - started) / UPDATES)
    return statistics.median(times[1:])


def ours(batch: int, precision: str) -> Callable[[], None]:
    """Return SAC updates of midway, sampling and relabelling included."""
    training = bench.filled("ant-u", "sac", batch, precision, updates_per_call=UPDATES)

    def update() -> None:
        training.arrays, training.totals = training.program.train(
            training.arrays, training.totals, training.replay, jax.random.key(0), 0
        )
        jax.block_until_ready(training.totals)

    return update


def theirs(batch: int) -> Callable[[], None]:
    """Return SAC updates of Stable-Baselines3 with its hindsight replay."""
    import gymnasium

    model = SAC(
        "MultiInputPolicy",
        gymnasium.make("midway/AntMaze-U-v0"),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=batch,
        learning_starts=STEPS,
        learning_rate=1e-3,
        device="cpu",
    )
    model.learn(total_timesteps=STEPS)

    def update() -> None:
        model.train(gradient_steps=UPDATES, batch_size=batch)

    return update


if __name__ == "__main__":
    main()
