"""See what writing checkpoints leaves in memory, and how much of that TensorStore's counters are.

    python benchmarks/checkpoint_memory.py

Writes the same small state again and again, as a run does, then asks TensorStore for its counters
as Orbax does for each checkpoint. Prints kilobytes that stay for each, and writes them to
``benchmarks/results/soak/checkpoints.json``.
"""

import ctypes
import gc
import json
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import tensorstore

from midway.training.checkpoint import Checkpoints

FILE = Path(__file__).parent / "results" / "soak" / "checkpoints.json"
ARRAYS = 120
"""About as many as RIS has, with its optimisers and the replay."""

FIRST, COUNTED = 100, 300
"""Repetitions before memory is looked at, and after."""


def main() -> None:
    """Measure both."""
    state = {str(number): jnp.ones((64, 64)) for number in range(ARRAYS)}
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(Path(folder))
        kept = {
            "arrays": ARRAYS,
            "repetitions": COUNTED,
            "kilobytes_of_a_checkpoint": growth(lambda step: checkpoints.save(step, state)),
            "kilobytes_of_asking_for_counters": growth(
                lambda step: tensorstore.experimental_collect_matching_metrics("/tensorstore/")
            ),
        }
    FILE.write_text(json.dumps(kept, indent=2) + "\n")
    print(json.dumps(kept, indent=2))


def growth(repeated: Callable[[int], object]) -> float:
    """Return the kilobytes that each repetition leaves in memory."""
    for step in range(FIRST):
        repeated(step)
    before = resident()
    for step in range(FIRST, FIRST + COUNTED):
        repeated(step)
    return round((resident() - before) / COUNTED / 1e3, 1)


def resident() -> int:
    """Return the bytes in memory, once what is free was given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    main()
