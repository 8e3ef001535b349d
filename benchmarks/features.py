"""Measure what the encoder of a run on `push` keeps of hand and puck.

    python benchmarks/features.py RUN...

A network learns hand and puck from the features of 2,000 images; how far off it is on 500 others
says what features hold. How far features move with 3 cm of either says how well it is seen. A
network that learns the value of ``zoo/push-state-ris`` from the features of two images says how
well critics could do with them; beside it the same from hand and puck themselves. Writes
``benchmarks/results/features/RUN.json``, named as the run's folder.
"""

import argparse
import json
from collections.abc import Mapping
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

VALUE = "zoo:push-state-ris"
RESULTS = Path(__file__).parent / "results" / "features"
LEARNED, HELD_OUT = 2_000, 500
PAIRS, HELD_OUT_PAIRS = 50_000, 5_000
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
        print(path, {name: found[name] for name in ("hand", "puck", "value")})


def measure(run: Path) -> dict[str, object]:
    """Return errors (m), and how far features move, for hand and puck."""
    encoder = encoder_of(run)
    env, rng = PushVectorEnv(), np.random.default_rng(0)
    pairs = [PushTask().sample(rng, 0.0) for _ in range(LEARNED + HELD_OUT)]
    states = np.stack([goal for _, goal in pairs])
    seen = features(encoder, env, states)
    misses = np.abs(predicted(seen, states, LEARNED) - states[LEARNED:])
    values = np.linalg.svd(seen - seen.mean(0), compute_uv=False) / len(seen) ** 0.5
    return {
        "singular_values": [round(float(value), 3) for value in values],
        **{
            name: {
                "error": round(float(np.linalg.norm(misses[:, part], axis=1).mean()), 4),
                "moved": round(moved(encoder, env, states[:HELD_OUT], part), 3),
            }
            for name, part in PARTS.items()
        },
        "value": value_errors({"features": seen, "states": states}, states),
    }


def encoder_of(run: Path) -> Encoder:
    """Return the encoder of a run, whether it is frozen yet or not."""
    policy = midway.load(run)
    if policy.encoder is not None:
        return policy.encoder
    if policy.agent.freezing is None or not policy.spec.is_image:
        raise SystemExit(f"{run}: reads no images")
    found: Encoder = policy.agent.freezing.encoder(policy.state)
    return found


def value_errors(
    told: Mapping[str, Float[np.ndarray, "n _"]], states: Float[np.ndarray, "n 4"]
) -> dict[str, float]:
    """Return root mean squared errors of the value of pairs, by what states are told by.

    The value is that of a policy that reads states (minus discounted steps to the goal); beside
    the errors is its standard deviation.
    """
    rng, last = np.random.default_rng(1), LEARNED + HELD_OUT
    known = rng.integers(0, LEARNED, (PAIRS, 2))
    pairs = np.concatenate([known, rng.integers(LEARNED, last, (HELD_OUT_PAIRS, 2))])
    starts, goals = states.astype(np.float32)[pairs.T]
    values = midway.load(VALUE).value(starts, goals)[:, None]
    errors = {"spread": float(values[PAIRS:].std())}
    for name, rows in told.items():
        found = predicted(np.concatenate([rows[pairs[:, 0]], rows[pairs[:, 1]]], 1), values, PAIRS)
        errors[name] = float(((found - values[PAIRS:]) ** 2).mean() ** 0.5)
    return {name: round(error, 2) for name, error in errors.items()}


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
    seen: Float[np.ndarray, "n F"], outputs: Float[np.ndarray, "n K"], learned: int
) -> Float[np.ndarray, "m K"]:
    """Return what a network that learned the outputs of the first rows says of the others."""
    known = outputs[:learned]
    inputs = jnp.asarray(standardised(seen, seen[:learned]))
    wanted = jnp.asarray(standardised(known, known))
    network = eqx.nn.MLP(seen.shape[1], outputs.shape[1], 256, 2, key=jax.random.key(0))
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
        network, state = step(network, state, jnp.asarray(rng.integers(0, learned, BATCH)))
    found = np.asarray(jax.vmap(network)(inputs[learned:]))
    return np.asarray(found * known.std(0) + known.mean(0))


def standardised(
    rows: Float[np.ndarray, "n D"], known: Float[np.ndarray, "m D"]
) -> Float[np.ndarray, "n D"]:
    """Return rows with the mean and spread of the known ones taken out."""
    return np.asarray((rows - known.mean(0)) / known.std(0))


if __name__ == "__main__":
    main()
