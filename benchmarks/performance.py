"""Measure what docs/performance.md shows: about six minutes on an idle machine.

    python benchmarks/performance.py

Each figure comes from a process of its own, mostly ``midway bench``. All go to
``benchmarks/results/speed/midway.json``; the tables are printed as Markdown.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results" / "speed" / "midway.json"
ONE_CORE = ("taskset", "--cpu-list", "0")
PRECISIONS = ("bf16", "f32")
BATCHES = (256, 512, 1024, 2048, 4096)
COPIES = (1, 8, 64, 256)


def main() -> None:
    """Measure, write and print everything."""
    found: dict[str, Any] = {"machine": bench("env", "--env", "point-u")["machine"]}
    found["update"] = [update("ant-u", b, p) for b in BATCHES for p in PRECISIONS]
    found["update_one_core"] = [update("ant-u", b, "bf16", ONE_CORE) for b in (256, 2048)]
    found["update_images"] = [update("push", 256, p) for p in PRECISIONS]
    found["environment"] = [environment(n) for n in COPIES]
    found["environment_one_core"] = [environment(64, ONE_CORE)]
    arguments = ("--env", "ant-u", "--batch", "256", "--precision", "bf16")
    found["loop"] = [bench("loop", *arguments)["loop"]]
    found["memory"] = [
        {"env": env, **bench("memory", "--env", env, "--precision", "bf16")["memory"]}
        for env in ("ant-u", "push")
    ]
    found["start"] = starts()
    RESULTS.write_text(json.dumps(found, indent=2) + "\n")
    for name, rows in found.items():
        if name != "machine":
            print(f"\n{name}\n")
            table(rows)


def bench(*arguments: str, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return what ``midway bench`` prints as JSON."""
    command = [*prefix, sys.executable, "-m", "midway.cli", "bench", *arguments, "--json"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    figures: dict[str, Any] = json.loads(printed)
    return figures


def update(env: str, batch: int, precision: str, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the figures of one update of RIS."""
    arguments = ("--env", env, "--batch", str(batch), "--precision", precision)
    figures = bench("update", *arguments, prefix=prefix)["update"]
    return {"env": env, "batch": batch, "precision": precision, **figures}


def environment(num_envs: int, prefix: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return how many steps copies of the ant take in a second."""
    arguments = ("--env", "ant-u", "--num-envs", str(num_envs))
    return {"num_envs": num_envs, **bench("env", *arguments, prefix=prefix)["env"]}


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
        command += ["--set", "random_steps=64", "log_every=8"]
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


def table(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    print("| " + " | ".join(rows[0]) + " |")
    print("| --- " * len(rows[0]) + "|")
    for row in rows:
        cells = [
            f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()
        ]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
