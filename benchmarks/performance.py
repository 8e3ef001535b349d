"""Measure what docs/performance.md shows, and how long LEAP plans, on an idle machine.

    python benchmarks/performance.py [PART...]

Each figure but the split of an update and the plans comes from a process of its own, mostly
``midway bench``. All go to ``benchmarks/results/speed/midway.json``; the tables are printed as
Markdown.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from midway import files
from midway.agents import ris
from midway.bench import pieces as measures
from midway.bench import plan as bench_plan
from midway.replay import buffer
from midway.training import state
from midway.training.checkpoint import Checkpoints

RESULTS = Path(__file__).parent / "results" / "speed" / "midway.json"
ONE_CORE = ("taskset", "--cpu-list", "0")
PRECISIONS = ("bf16", "f32")
BATCHES = (256, 512, 1024, 2048, 4096)
NUM_ENVS = (1, 8, 64, 256)
PROCESSES = 3
"""That measure each update."""


def main() -> None:
    """Measure what is named, or everything; write and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    names = parser.parse_args().parts or list(PARTS)
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    found["machine"] = bench("env", "--env", "point-u")["machine"]
    for name in names:
        found[name] = PARTS[name]()
        RESULTS.write_text(json.dumps(found, indent=2) + "\n")
        print(f"\n{name}\n")
        table(found[name])


def bench(*arguments: str, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return what ``midway bench`` prints as JSON."""
    command = [*prefix, sys.executable, "-m", "midway.cli", "bench", *arguments, "--json"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    figures: dict[str, Any] = json.loads(printed)
    return figures


def update(env: str, batch: int, precision: str, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the figures of one update of RIS: of several processes, the median one's."""
    arguments = ("--env", env, "--batch", str(batch), "--precision", precision)
    found = [bench("update", *arguments, prefix=prefix)["update"] for _ in range(PROCESSES)]
    median = sorted(found, key=lambda figures: figures["update_ms"])[PROCESSES // 2]
    return {"env": env, "batch": batch, "precision": precision, **median}


def environment(num_envs: int, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return how many steps parallel ants take in a second."""
    arguments = ("--env", "ant-u", "--num-envs", str(num_envs))
    return {"num_envs": num_envs, **bench("env", *arguments, prefix=prefix)["env"]}


def loops() -> list[dict[str, Any]]:
    """Return the share of the loop that is spent in updates."""
    arguments = ("--env", "ant-u", "--batch", "256", "--precision", "bf16")
    return [bench("loop", *arguments)["loop"]]


def memory(env: str) -> dict[str, Any]:
    """Return what a run takes with a full replay."""
    return {"env": env, **bench("memory", "--env", env, "--precision", "bf16")["memory"]}


def split(batch: int) -> dict[str, Any]:
    """Return how long the parts of one update of RIS take, each compiled alone (ms)."""
    training = measures.filled("ant-u", "ris", batch, "bf16", updates_per_call=1)
    agent, spec, mix = training.state, training.program.spec, training.setup.train.relabel
    key = jax.random.key(0)
    sample = jax.jit(lambda replay: buffer.sample(replay, spec, mix, batch, key))
    drawn = sample(training.replay)
    critics = eqx.filter_jit(ris.update_critic)
    subgoal_policy = eqx.filter_jit(ris.update_subgoal_policy)
    policy = eqx.filter_jit(ris.update_policy)
    targets = eqx.filter_jit(ris.update_targets)
    times = measures.medians(
        {
            "sample": lambda: sample(training.replay),
            "critics": lambda: arrays(critics(agent, drawn.observation, drawn, key)),
            "subgoal_policy": lambda: arrays(subgoal_policy(agent, drawn)),
            "policy": lambda: arrays(policy(agent, drawn, key, key)),
            "targets": lambda: arrays(targets(agent)),
        }
    )
    return {"batch": batch, **times}


def plans() -> list[dict[str, Any]]:
    """Return the seconds of a plan of LEAP by samples and subgoals; 10,000 and 11 are published."""
    sizes = [("bf16", samples, 11) for samples in (1_000, 2_500, 5_000, 10_000)]
    sizes += [("bf16", 2_500, subgoals) for subgoals in (2, 5)]
    sizes += [("f32", 2_500, 11)]
    return [
        {"precision": precision, **bench_plan.plan("ant-u", precision, samples, subgoals)}
        for precision, samples, subgoals in sizes
    ]


def arrays(tree: Any) -> Any:
    """Return the arrays of a tree, to wait for."""
    return eqx.filter(tree, eqx.is_array)


def starts() -> list[dict[str, Any]]:
    """Return the seconds from typing ``midway train`` to the first update, twice."""
    rows = []
    for env in ("point-u", "ant-u"):
        with tempfile.TemporaryDirectory() as cache:
            seconds = [first_update(env, cache) for _ in range(2)]
        rows.append({"env": env, "first_start_s": seconds[0], "second_start_s": seconds[1]})
    return rows


def first_update(env: str, cache: str) -> float:
    """Return the seconds until the first row of ``metrics.csv`` is there."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "midway.cli", "train", env, "--out", str(run)]
        command += ["--set", "random_steps=64", "log_every=8", "evaluation_episodes=1"]
        started = time.perf_counter()
        environ = {**os.environ, "XDG_CACHE_HOME": cache}
        process = subprocess.Popen(command, env=environ, stderr=subprocess.DEVNULL)
        while not (metrics := run / "metrics.csv").exists() or metrics.read_text().count("\n") < 2:
            if process.poll() is not None:
                raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
            time.sleep(0.01)
        seconds = time.perf_counter() - started
        process.kill()
        process.wait()
    return round(seconds, 2)


def checkpoint(transitions: int) -> dict[str, Any]:
    """Return the processor time of a checkpoint of the ant, and of the checksums in it.

    The replay is full of noise, which cannot be compressed.
    """
    training = measures.filled(
        "ant-u", "sac", 256, "f32", 1, random_steps=16, replay_capacity=transitions
    )
    key = jax.random.key(0)
    rows = {name: jax.random.normal(key, x.shape) for name, x in training.replay.rows.items()}
    stored = state.state_dict(replace(training, replay=training.replay._replace(rows=rows)))
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(Path(folder))
        seconds = [processor_time(partial(checkpoints.save, step, stored)) for step in range(5)]
        written = [path for path in Path(folder, "4").rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in written)
        checksums = processor_time(lambda: [files.checksum(path) for path in written])
        resuming = processor_time(partial(checkpoints.verify, 4))
    whole = statistics.median(seconds)
    return {
        "transitions": transitions,
        "mb": round(size / 1e6, 1),
        "save_s": round(whole, 3),
        "checksums_s": round(checksums, 3),
        "share_of_save": f"{checksums / whole:.0%}",
        "verify_s": round(resuming, 3),
    }


def processor_time(action: Callable[[], object]) -> float:
    """Return the processor time of an action in all threads (s)."""
    started = time.process_time()
    action()
    return time.process_time() - started


def table(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    print("| " + " | ".join(rows[0]) + " |")
    print("| --- " * len(rows[0]) + "|")
    for row in rows:
        cells = [
            f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()
        ]
        print("| " + " | ".join(cells) + " |")


PARTS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "update": lambda: [update("ant-u", b, p) for b in BATCHES for p in PRECISIONS],
    "update_one_core": lambda: [update("ant-u", b, "bf16", ONE_CORE) for b in (256, 2048)],
    "update_images": lambda: [update("push", 256, p) for p in PRECISIONS],
    "split": lambda: [split(batch) for batch in (256, 2048)],
    "environment": lambda: [environment(n) for n in NUM_ENVS],
    "environment_one_core": lambda: [environment(64, ONE_CORE)],
    "loop": loops,
    "memory": lambda: [memory(env) for env in ("ant-u", "push")],
    "start": starts,
    "plan": plans,
    "checkpoint": lambda: [checkpoint(count) for count in (100_000, 1_000_000)],
}


if __name__ == "__main__":
    main()
