"""Agents on small problems: states of 4 as goals, or goals of 2 beside observations of 6."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agent import AnyAgent
from midway.agents import registry
from midway.settings import names
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

TASK = DistanceTask(((0, 1),), 0.5)
SPECS = {
    "states": EnvSpec("states", (4,), "float32", (4,), 2, 50, True, None, TASK),
    "pairs": EnvSpec("pairs", (6,), "float32", (2,), 2, 50, False, None, TASK),
}


class Case(NamedTuple):
    """An agent, compiled once for all tests, its start on a specification, and a batch."""

    agent: AnyAgent
    spec: EnvSpec
    state: Any
    batch: Batch
    update: Any


def draw_batch(spec: EnvSpec, size: int, seed: int = 0) -> Batch:
    """Return random transitions whose reward and termination belong to their goal."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    observation, goal = normal(size, *spec.observation_shape), normal(size, *spec.goal_shape)
    next_observation = observation + 0.3 * normal(size, *spec.observation_shape)
    goal = goal.at[: size // 4, :2].set(next_observation[: size // 4, :2] + 0.1)  # reached
    reward, terminated = spec.task(next_observation[:, :2], goal[:, :2])
    candidate = normal(size, *spec.observation_shape)
    achieved = candidate if spec.goal_is_observation else normal(size, *spec.goal_shape)
    action = jnp.asarray(rng.uniform(-1, 1, (size, spec.action_dim)), jnp.float32)
    return Batch(
        observation=observation,
        action=action,
        reward=jnp.asarray(reward),
        terminated=terminated,
        next_observation=next_observation,
        goal=goal,
        subgoal_candidate=Subgoal(candidate, achieved),
    )


@functools.cache
def make_case(name: str, kind: str) -> Case:
    agent, spec = registry.get(name), SPECS[kind]
    # Large learning rates, so that one step moves what the next step reads.
    rates = {field: 0.01 for field in names(agent.Config) if field.endswith("_learning_rate")}
    state = agent.create(agent.Config(hidden=(16, 16), **rates), spec, jax.random.key(0))
    return Case(agent, spec, state, draw_batch(spec, 32), eqx.filter_jit(agent.update))


@pytest.fixture(params=[("ris", "states"), ("ris", "pairs"), ("sac", "pairs")], ids="-".join)
def case(request: pytest.FixtureRequest) -> Case:
    """Each agent with goals that are no observations, and RIS in the paper's case as well."""
    return make_case(*request.param)


@pytest.fixture(params=SPECS)
def ris_case(request: pytest.FixtureRequest) -> Case:
    """RIS with goals that are observations, and with goals that are not."""
    return make_case("ris", request.param)


@pytest.fixture(scope="session")
def make_batch() -> Callable[[EnvSpec, int], Batch]:
    """Return the function that draws a random batch for a specification."""
    return draw_batch


@pytest.fixture
def pairs() -> Case:
    """RIS with goals that are no observations, the general case."""
    return make_case("ris", "pairs")


@pytest.fixture
def sac_case() -> Case:
    """SAC with goals that are no observations."""
    return make_case("sac", "pairs")


@pytest.fixture(params=["ris", "sac"])
def state_case(request: pytest.FixtureRequest) -> Case:
    """Each agent where goals are observations."""
    return make_case(request.param, "states")
