"""How fast the pieces run on this machine, and what they take: update, environment, replay, loop.

Times are medians over repetitions after a warm-up; where two things are compared, their repetitions
alternate, so that a machine that drifts slows both.
"""

import importlib.metadata
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from midway import api
from midway.envs import registry as environments
from midway.envs.simulation import SimulationVectorEnv
from midway.replay import buffer
from midway.replay.storage import num_bytes
from midway.runs.folder import RunFolder
from midway.training import loop, state, step
from midway.training.compilation import give_back_memory
from midway.types import EnvSpec, JsonObject, Metrics

Figures: TypeAlias = JsonObject
"""Figures by name, as they are printed."""
Piece: TypeAlias = Callable[[], PyTree]
"""What is timed: returns the arrays that it is done with."""

REPETITIONS = 30
ROWS = 20_000
"""Rows in the replay that updates draw from: more than the processor's caches hold."""
IMAGE_ROWS = 4_000
"""The same for images, which are of noise: what the numbers are costs nothing."""


def machine() -> Figures:
    """Return what the figures depend on."""
    packages = ("midway", "jax", "jaxlib", "mujoco", "numpy")
    cores = len(os.sched_getaffinity(0))
    return {
        "processor": _processor(),
        "cores": cores,
        "threads": cores,  # of compiled programs, and again as many of simulations
        "device": jax.devices()[0].device_kind,
        "devices": len(jax.devices()),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def medians(pieces: dict[str, Piece], repetitions: int = REPETITIONS) -> Figures:
    """Return the median time of each piece in milliseconds; the pieces alternate."""
    times: dict[str, list[float]] = {name: [] for name in pieces}
    for piece in pieces.values():
        jax.block_until_ready(piece())
    for _ in range(repetitions):
        for name, piece in pieces.items():
            started = time.perf_counter()
            jax.block_until_ready(piece())
            times[name].append(time.perf_counter() - started)
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def update(env: str, agent: str, batch: int, precision: str) -> Figures:
    """Time one update, sampling and relabelling included, beside its matrix products alone.

    Where observations are images, also time one on their features, as with a frozen encoder.
    The limit is the time that the matrix products would take at the rate of one of 2048 x 256 by
    256 x 256 in the same precision, measured in turn with the update.

    Args:
        env: Environment, for the sizes.
        agent: Agent.
        batch: Transitions of one update.
        precision: ``f32`` or ``bf16``.
    """
    training = filled(env, agent, batch, precision, updates_per_call=1)
    trainings = {"update_ms": training}
    if training.program.spec.is_image:
        frozen = filled(env, agent, batch, precision, updates_per_call=1)
        state.freeze_encoder(frozen)
        trainings["update_on_features_ms"] = frozen
    arguments = (jax.random.key(0), 0)
    inputs = (training.arrays, training.totals, training.replay, *arguments)
    flops = _product_flops(training.program.train, inputs)

    def one_update(training: state.Training) -> Metrics:
        training.arrays, training.totals = training.program.train(
            training.arrays, training.totals, training.replay, *arguments
        )
        return training.totals

    sample = jax.jit(
        lambda replay, key: buffer.sample(
            replay, training.program.spec, training.setup.train.relabel, batch, key
        )
    )
    times = medians(
        {
            **{name: partial(one_update, each) for name, each in trainings.items()},
            "sample_ms": lambda: sample(training.replay, jax.random.key(1)),
            "product": _reference_product(precision),
        }
    )
    rate = 2 * 2048 * 256 * 256 / (times.pop("product") / 1e3)
    limit = 1e3 * flops / rate
    return {
        **times,
        "gflop": flops / 1e9,
        "product_gflop_per_s": rate / 1e9,
        "limit_ms": limit,
        "share_of_limit": limit / times["update_ms"],
    }


def environment(env: str, num_envs: int) -> Figures:
    """Compare steps of the vector environment with steps of its bare simulations on all cores.

    Args:
        env: Environment.
        num_envs: Parallel environments.
    """
    vector = environments.make_vec(env, num_envs=num_envs)
    vector.reset(seed=0)
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1, 1, (num_envs, vector.goal_spec.action_dim)).astype("float32")
    counts = 20

    def steps() -> None:
        for _ in range(counts):
            _, _, terminated, truncated, _ = vector.step(actions)
            if (terminated | truncated).any():
                vector.reset(options={"reset_mask": terminated | truncated})

    pieces: dict[str, Piece] = {"environment": steps}
    if isinstance(vector, SimulationVectorEnv):
        batch, substeps = vector.batch, vector.substeps

        def bare() -> None:
            for _ in range(counts):
                batch.step(nstep=substeps)

        pieces["bare"] = bare
    times = medians(pieces)
    per_second = {n: 1e3 * counts * num_envs / milliseconds for n, milliseconds in times.items()}
    figures = {"steps_per_s": per_second["environment"]}
    if "bare" in per_second:
        figures["bare_steps_per_s"] = per_second["bare"]
        figures["share_of_bare"] = per_second["environment"] / per_second["bare"]
    return figures


def replay(env: str, batch: int) -> Figures:
    """Time writing one step of 8 environments and drawing a batch, and say what the ring takes.

    Args:
        env: Environment, for the sizes.
        batch: Transitions of one draw.
    """
    capacity = transitions_of(environments.make_vec(env).goal_spec)
    training = filled(env, "sac", batch, "f32", 1, replay_capacity=capacity)
    observation = training.collector.observation
    actions = np.zeros(
        (training.setup.train.num_envs, training.program.spec.action_dim), np.float32
    )
    everyone = np.ones(len(actions), np.bool_)
    mix = training.setup.train.relabel
    sample = jax.jit(lambda ring, key: buffer.sample(ring, training.program.spec, mix, batch, key))

    def add() -> Int[Array, " K"]:
        training.replay = step.add(training.replay, actions, observation, everyone)
        return training.replay.num_rows

    times = medians(
        {"add_ms": add, "sample_ms": lambda: sample(training.replay, jax.random.key(0))}
    )
    size = buffer.memory_bytes(training.program.spec, capacity, training.setup.train.num_envs)
    return {**times, "gib": size / 2**30}


def memory(env: str, agent: str, batch: int, precision: str) -> Figures:
    """Return what a run takes after an update from a full-sized replay, in GiB.

    ``arrays_gib`` adds up the sizes of the replay's arrays, ``replay_gib`` is what the process
    gives back when they are freed, ``process_gib`` is all that it had in main memory before, and
    ``peak_gib`` the most that it ever had: to be looked at in a process that does nothing else.

    Args:
        env: Environment.
        agent: Agent.
        batch: Transitions of one update.
        precision: ``f32`` or ``bf16``.
    """
    spec = environments.make_vec(env).goal_spec
    episodes = -(-transitions_of(spec) // (8 * spec.max_episode_steps))
    rows = 8 * episodes * (spec.max_episode_steps + 2)
    training = filled(env, agent, batch, precision, 1, replay_capacity=rows)
    arguments = (training.arrays, training.totals, training.replay, jax.random.key(0), 0)
    jax.block_until_ready(training.program.train(*arguments))
    give_back_memory()  # as a run does when it logs
    size = num_bytes(training.replay)
    process, peak = resident_bytes()
    for array in jax.tree.leaves(training.replay):
        array.delete()
    figures = {"arrays": size, "replay": process - resident_bytes()[0], "process": process}
    gib = {f"{name}_gib": number / 2**30 for name, number in {**figures, "peak": peak}.items()}
    return {"transitions": 8 * episodes * spec.max_episode_steps, **gib}


def transitions_of(spec: EnvSpec) -> int:
    """Return how many transitions a full-sized replay holds: a million, or 100,000 of images."""
    return 100_000 if spec.is_image else 1_000_000


def resident_bytes() -> tuple[int, int]:
    """Return what this process has in main memory, and the most that it ever had."""
    lines = Path("/proc/self/status").read_text().splitlines()
    values = {line.partition(":")[0]: line.split()[1] for line in lines if "kB" in line}
    return 1024 * int(values["VmRSS"]), 1024 * int(values["VmHWM"])


def whole_loop(env: str, agent: str, batch: int, precision: str) -> Figures:
    """Return the share of the loop's time that is spent inside updates, at one update per step.

    Args:
        env: Environment.
        agent: Agent.
        batch: Transitions of one update.
        precision: ``f32`` or ``bf16``.
    """
    training = filled(env, agent, batch, precision, updates_per_call=8)
    program = training.program

    def turn() -> Metrics:
        loop.advance(training)
        return training.totals

    def updates() -> Metrics:
        training.arrays, training.totals = program.train(
            training.arrays, training.totals, training.replay, jax.random.key(0), 0
        )
        return training.totals

    times = medians({"turn": turn, "updates": updates})
    num_envs = training.setup.train.num_envs
    return {
        "steps_per_s": 1e3 * num_envs / times["turn"],
        "share_in_updates": times["updates"] / times["turn"],
    }


def filled(
    env: str,
    agent: str,
    batch: int,
    precision: str,
    updates_per_call: int,
    **changes: int | float | str,
) -> state.Training:
    """Return a run of 8 environments that writes nothing, just before its first update.

    Args:
        env: Environment.
        agent: Agent.
        batch: Transitions of one update.
        precision: ``f32`` or ``bf16``.
        updates_per_call: Updates that one compiled call does.
        changes: Other settings of `midway.training.config.TrainConfig`.
    """
    settings: dict[str, object] = {
        "num_envs": 8,
        "batch_size": batch,
        "encoder_batch_size": 0,
        "encoder_updates_per_step": 0,
        "precision": precision,
        "updates_per_step": updates_per_call / 8,
        "random_steps": ROWS,
        "replay_capacity": 2 * ROWS,
        **changes,
    }
    config = api.configure(env, agent, "quick", 0, settings)
    folder = RunFolder(Path(tempfile.gettempdir()) / "midway-bench")
    training = state.start(api.setup_of(config, folder))
    if training.program.spec.is_image:
        _fill_with_noise(training)
    while training.counters.steps < training.setup.train.random_steps:
        loop.advance(training)
    return training


def _fill_with_noise(training: state.Training) -> None:
    """Write episodes of noise into the replay, which takes less long than to draw images."""
    num_envs = training.setup.train.num_envs
    everyone = np.ones(num_envs, np.bool_)
    generator = np.random.default_rng(0)
    actions = np.zeros((num_envs, training.program.spec.action_dim), np.float32)
    for number in range(1, IMAGE_ROWS // num_envs + 1):
        noise = {
            name: generator.integers(0, 256, value.shape, np.uint8)
            if value.dtype == np.uint8
            else value
            for name, value in training.collector.observation.items()
        }
        training.replay = step.add(training.replay, actions, noise, everyone)
        if number % training.program.spec.max_episode_steps == 0:
            training.replay = step.begin(training.replay, noise, everyone)
    training.replay = step.begin(training.replay, training.collector.observation, everyone)
    steps = training.setup.train.random_steps
    training.counters = training.counters._replace(steps=steps)


def _product_flops(function: Callable[..., PyTree], arguments: tuple[PyTree, ...]) -> float:
    """Return the floating-point operations of all matrix products in a compiled function."""
    return sum(_products(jax.make_jaxpr(function)(*arguments).jaxpr))


def _products(jaxpr: Any) -> list[float]:
    """Return 2 x outputs x contracted length of each product, also of inner functions and loops."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            lengths = [equation.invars[0].aval.shape[axis] for axis in contracted]
            found.append(2.0 * equation.outvars[0].aval.size * float(np.prod(lengths)))
        turns = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for inner in jax.extend.core.jaxprs_in_params(equation.params):
            found += [turns * product for product in _products(inner)]
    return found


def _reference_product(precision: str) -> Piece:
    """Return a function of ten matrix products of 2048 x 256 by 256 x 256 in one call."""
    dtype = jnp.bfloat16 if precision == "bf16" else jnp.float32
    x = jnp.ones((2048, 256), dtype)
    weight = jnp.ones((256, 256), dtype)
    product = jax.jit(lambda a, b: jnp.matmul(a, b, preferred_element_type=jnp.float32))
    return lambda: product(x, weight)
