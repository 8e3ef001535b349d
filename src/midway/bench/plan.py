"""How long LEAP takes to plan an episode on this machine."""

import statistics
import time
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from midway import api
from midway.agents import leap
from midway.bench.pieces import Figures
from midway.envs import registry as environments

REPETITIONS = 3
"""Without a warm-up, for a plan can take half a minute; it is compiled before."""


def plan(
    env: str, precision: str, samples: int | None = None, subgoals: int | None = None
) -> Figures:
    """Time one plan at the start of one episode, with the preset ``paper`` and untrained networks.

    Args:
        env: Environment.
        precision: ``f32`` or ``bf16``.
        samples: Candidates of an iteration, instead of the preset's.
        subgoals: Subgoals of the plan, instead of the preset's.
    """
    config = api.configure(env, "leap", "paper").hyperparameters
    config = replace(
        config,
        precision=precision,
        plan_samples=samples or config.plan_samples,
        num_subgoals=subgoals or config.num_subgoals,
    )
    spec = environments.make_vec(env).goal_spec
    state = leap.create(config, spec, jax.random.key(0))
    inputs = (
        state.encoder(jnp.zeros((1, *spec.observation_shape), spec.observation_dtype))[0],
        state.encoder(jnp.zeros((1, *spec.goal_shape), spec.observation_dtype))[0],
        jnp.zeros((), jnp.int32),
        jnp.zeros((config.num_subgoals, config.latent_size)),
        jax.random.key(1),
    )
    search: Any = eqx.filter_jit(leap.plan)
    compiled = search.lower(state, *inputs).compile()
    times = []
    for _ in range(REPETITIONS):
        started = time.perf_counter()
        jax.block_until_ready(compiled(state, *inputs))
        times.append(time.perf_counter() - started)
    return {
        "samples": config.plan_samples,
        "iterations": config.plan_iterations,
        "subgoals": config.num_subgoals,
        "plan_s": statistics.median(times),
    }
