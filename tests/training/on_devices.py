"""What one and four devices make of the same run; started by ``test_devices.py`` on virtual ones.

Writes ``found.json``, and arrays by name: ``start-N.npz`` after some updates on N devices, and
``A-then-B.npz`` after more updates on B devices from the checkpoint of A devices.
"""

import json
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from midway import api
from midway.agents import ris
from midway.envs.push import IMAGE_SPEC
from midway.networks import encoder as encoders
from midway.replay import buffer
from midway.runs.folder import RunFolder
from midway.training import freeze, loop, state, step
from midway.training.arrays import named_arrays
from midway.training.checkpoint import Checkpoints
from midway.training.compilation import use_compilation_cache
from midway.training.devices import Devices
from midway.training.state import Training

NUMBER = 4
SMALL = {
    "hidden": (16, 16),
    "batch_size": 16,
    "num_envs": 8,
    "random_steps": 80,
    "replay_capacity": 4_000,
}


def build(folder: Path, devices: int) -> Training:
    config = api.configure("point-u", "ris", changes={**SMALL, "devices": devices})
    return state.start(api.setup_of(config, RunFolder(folder)))


def advance(training: Training, updates: int) -> None:
    while training.counters.updates < updates:
        loop.advance(training)


def write(path: Path, training: Training) -> None:
    arrays = {f"agent.{name}": a for name, a in named_arrays(training.arrays).items()}
    arrays |= {f"totals.{name}": total for name, total in training.totals.items()}
    arrays |= {f"replay.{name}": a for name, a in named_arrays(training.replay).items()}
    np.savez(path, **{name: np.asarray(array) for name, array in arrays.items()})


def pointers(tree: Any) -> list[int]:
    """Return where every block of every array lies."""
    leaves = jax.tree.leaves(tree)
    return [s.data.unsafe_buffer_pointer() for leaf in leaves for s in leaf.addressable_shards]


def sent(program: str) -> list[int]:
    """Return the numbers in each array that one device sends to others."""
    calls = re.findall(r"= (.*?) (?:all-|reduce-scatter|collective-)[a-z-]+\(", program)
    shapes = [shape for call in calls for shape in re.findall(r"\w+\[([\d,]*)\]", call)]
    return [int(np.prod([int(n) for n in shape.split(",") if n])) for shape in shapes]


def look(training: Training) -> dict[str, Any]:
    """Return how the run lies on its devices; advances it by one call."""
    program: Any = training.program
    observations = training.replay.rows["observation"]
    key = training.streams.update_key
    arguments = (training.arrays, training.totals, training.replay, key)
    updates = jax.device_put(np.int32(0), key.sharding)
    compiled = program.train.lower(*arguments, updates).compile()
    lanes = [s.data.shape[0] for s in observations.addressable_shards]
    lane_size = observations[0].size
    before = pointers(training.replay)
    replay, arrays = training.replay, training.arrays
    with jax.transfer_guard("disallow"):
        training.arrays, training.totals = compiled(*arguments, updates)
        jax.block_until_ready(training.arrays)
    training.replay = training.collector.step(training.replay, partial(loop._choose, training))
    return {
        "compilations": {n: getattr(program, n)._cache_size() for n in ("train", "act")},
        "lanes": lanes,
        "replicas": [len(a.sharding.device_set) for a in jax.tree.leaves(training.arrays)],
        "largest_sent": max(sent(compiled.as_text())),
        "numbers_in_a_lane": lane_size,
        "in_place": before == pointers(training.replay),
        "given_away": [a.is_deleted() for a in jax.tree.leaves((replay, arrays))],
    }


def features_of_lanes() -> dict[str, Any]:
    """Return how the features of a replay of images lie, and how far they are from one device's."""
    spec = replace(IMAGE_SPEC, observation_shape=(31, 31, 3))
    encoder = encoders.create(spec, ris.Config(), jax.random.key(0))
    observation = np.random.default_rng(0).integers(0, 256, (8, 31, 31, 3), np.uint8)
    positions = np.zeros((8, 4), np.float32)
    seen = {"observation": observation, "desired_goal": observation[::-1]}
    seen |= {"achieved_state": positions, "desired_state": positions}
    found = []
    for number in (1, NUMBER):
        replay = Devices.first(number).allocate(partial(buffer.create, spec, 1_632, 8))
        replay = step.begin(replay, seen, np.ones(8, np.bool_))
        found.append(freeze.encoded_replay(replay, encoder).rows["observation"])
    difference = float(np.abs(np.asarray(found[0]) - np.asarray(found[1])).max())
    return {
        "lanes_of_features": [s.data.shape[0] for s in found[1].addressable_shards],
        "difference_of_features": difference,
        "largest_feature": float(np.abs(np.asarray(found[0])).max()),
    }


def main(folder: Path) -> None:
    use_compilation_cache()
    trainings = {number: build(folder, number) for number in (1, NUMBER)}
    for number, training in trainings.items():
        advance(training, 8)
        write(folder / f"start-{number}.npz", training)
        checkpoints = Checkpoints(folder / f"checkpoints-{number}")
        checkpoints.save(training.counters.steps, state.state_dict(training))
    for number, other in ((1, NUMBER), (NUMBER, 1)):
        checkpoints = Checkpoints(folder / f"checkpoints-{number}")
        resumed = build(folder, other)
        resumed = state.restore(resumed, checkpoints, resumed_at(checkpoints))
        advance(resumed, 16)
        write(folder / f"{number}-then-{other}.npz", resumed)
    advance(trainings[1], 16)
    write(folder / "1-then-1.npz", trainings[1])
    found = look(trainings[NUMBER]) | features_of_lanes()
    (folder / "found.json").write_text(json.dumps(found))


def resumed_at(checkpoints: Checkpoints) -> int:
    step = checkpoints.latest()
    assert step is not None
    return step


if __name__ == "__main__":
    main(Path(sys.argv[1]))
