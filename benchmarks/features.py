"""Measure what the frozen encoder of a run on `push` keeps of hand and puck.

    python benchmarks/features.py RUN...

A network learns hand and puck from the features of 2,000 images; how far off it is on 500 others
says what features hold. How far features move with 3 cm of either says how well it is seen. Writes
``benchmarks/results/features/RUN.json``, named as the run's folder.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import midway
from midway.agent import Encoder
from midway.envs.push import PushVectorEnv
from midway.envs.push_scene import PushTask
from midway.runs.folder import RunFolder, read_json

RESULTS = Path(__file__).parent / "results" / "features"
LEARNED, HELD_OUT = 2_000, 500
STEPS, BATCH, RATE = 3_000, 128, 2e-3
MOVED = 0.03
"""How far hand or puck are moved, towards the middle of where they may be (m)."""
PARTS = {"hand": slice(0, 2), "puck": slice(2, 4)}


def main() -> None:
    """Measure the encoders of some runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    RESULTS.mkdir(parents=True, exist_ok=True)
    for run in parser.parse_args().runs:
        folder = RunFolder(run)
        record = read_json(folder.config_file)
        found = {"command": record["command"], "commit": record["commit"], **measure(run)}
        path = RESULTS / f"{folder.path.resolve().name}.json"
        path.write_text(json.dumps(found, indent=2) + "\n")
        print(path, {name: found[name] for name in ("hand", "puck")})


def measure(run: Path) -> dict[str, object]:
    """Return errors (m), and how far features move, for hand and puck."""
    policy = midway.load(run)
    if policy.encoder is None:
        raise SystemExit(f"{run}: its policy has no frozen encoder")
    env, rng = PushVectorEnv(), np.random.default_rng(0)
    pairs = [PushTask().sample(rng, 0.0) for _ in range(LEARNED + HELD_OUT)]
    states = np.stack([goal for _, goal in pairs])
    seen = features(policy.encoder, env, states)
    misses = np.abs(predicted(seen, states) - states[LEARNED:])
    values = np.linalg.svd(seen - seen.mean(0), compute_uv=False) / len(seen) ** 0.5
    return {
        "singular_values": [round(float(value), 3) for value in values],
        **{
            name: {
                "error": round(float(np.linalg.norm(misses[:, part], axis=1).mean()), 4),
                "moved": round(moved(policy.encoder, env, states[:HELD_OUT], part), 3),
            }
            for name, part in PARTS.items()
        },
    }


def features(
    encoder: Encoder, env: PushVectorEnv, states: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n F"]:
    """Return the features of images of these states."""
    chunks = np.split(states, len(states) // 250)
    return np.concatenate([np.asarray(encoder(jnp.asarray(env.images(part)))) for part in chunks])


def moved(
    encoder: Encoder, env: PushVectorEnv, states: Float[np.ndarray, "n 4"], part: slice
) -> float:
    """Return the mean distance of features of states and of those with one part moved."""
    towards = states[:, part].mean(0) - states[:, part]
    other = states.copy()
    other[:, part] += MOVED * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    change = features(encoder, env, other) - features(encoder, env, states)
    return float(np.linalg.norm(change, axis=1).mean())


def predicted(
    seen: Float[np.ndarray, "n F"], states: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "m 4"]:
    """Return what a network that learned of the first rows says of the others."""
    inputs = jnp.asarray(standardised(seen, seen[:LEARNED]))
    wanted = jnp.asarray(standardised(states, states[:LEARNED])[:LEARNED])
    network = eqx.nn.MLP(seen.shape[1], 4, 256, 2, key=jax.random.key(0))
    adam = optax.adamw(optax.cosine_decay_schedule(RATE, STEPS), weight_decay=1e-3)

    def loss(network: eqx.nn.MLP, rows: Array) -> Array:
        return ((jax.vmap(network)(inputs[rows]) - wanted[rows]) ** 2).mean()

    @eqx.filter_jit
    def step(
        network: eqx.nn.MLP, state: optax.OptState, rows: Array
    ) -> tuple[eqx.nn.MLP, optax.OptState]:
        gradient = eqx.filter_grad(loss)(network, rows)
        change, state = adam.update(gradient, state, eqx.filter(network, eqx.is_array))
        return eqx.apply_updates(network, change), state

    state, rng = adam.init(eqx.filter(network, eqx.is_array)), np.random.default_rng(0)
    for _ in range(STEPS):
        network, state = step(network, state, jnp.asarray(rng.integers(0, LEARNED, BATCH)))
    known = states[:LEARNED]
    found = np.asarray(jax.vmap(network)(inputs[LEARNED:]))
    return np.asarray(found * known.std(0) + known.mean(0))


def standardised(
    rows: Float[np.ndarray, "n D"], known: Float[np.ndarray, "m D"]
) -> Float[np.ndarray, "n D"]:
    """Return rows with the mean and spread of the known ones taken out."""
    return np.asarray((rows - known.mean(0)) / known.std(0))


if __name__ == "__main__":
    main()
