"""See what writing checkpoints leaves in memory.

    python benchmarks/checkpoint_memory.py

Writes the same small state again and again, as a run does. Prints the kilobytes that stay for
each, and writes them to ``benchmarks/results/soak/checkpoints.json``.
"""

import ctypes
import gc
import json
import resource
import tempfile
from pathlib import Path

import jax.numpy as jnp

from midway.training.checkpoint import Checkpoints

FILE = Path(__file__).parent / "results" / "soak" / "checkpoints.json"
ARRAYS = 120
"""About as many as RIS has, with its optimisers and the replay."""

FIRST, COUNTED = 100, 300
"""Repetitions before memory is looked at, and after."""


def main() -> None:
    """Measure it."""
    state = {str(number): jnp.ones((64, 64)) for number in range(ARRAYS)}
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(Path(folder))
        for step in range(FIRST):
            checkpoints.save(step, state)
        before = resident()
        for step in range(FIRST, FIRST + COUNTED):
            checkpoints.save(step, state)
        grown = round((resident() - before) / COUNTED / 1e3, 1)
    kept = {"arrays": ARRAYS, "repetitions": COUNTED, "kilobytes_of_a_checkpoint": grown}
    FILE.write_text(json.dumps(kept, indent=2) + "\n")
    print(json.dumps(kept, indent=2))


def resident() -> int:
    """Return the bytes in memory, once what is free was given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    main()
