"""Both agents learn a point on a line, whose values and best subgoals are known.

The point moves at most 0.1 a step and reaches a goal nearer than 0.05: it needs d steps, the
ceiling of (|s - g| - 0.05) / 0.1, and V(s, g) = -(1 - γ^d) / (1 - γ). The state that makes the
worse of the two ways shortest is the midpoint. Actions beyond ±1/3 are full steps, so that a policy
that explores loses nothing.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import ris, sac
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

STEP, THRESHOLD, DISCOUNT = 0.1, 0.05, 0.95
TASK = DistanceTask(((0,),), THRESHOLD)
SPEC = EnvSpec("line", (1,), "float32", (1,), 1, 40, True, None, TASK)
UPDATES, BATCH = 1000, 128
CONFIG = {
    "hidden": (32, 32),
    "discount": DISCOUNT,
    "target_update_rate": 0.05,
    "critic_learning_rate": 3e-3,
    "policy_learning_rate": 3e-3,
}
CONFIGS = {
    ris: ris.Config(**CONFIG, subgoal_learning_rate=3e-3),
    sac: sac.Config(**CONFIG, entropy_learning_rate=1e-2),
}


def move(position: np.ndarray, action: np.ndarray) -> np.ndarray:
    return np.clip(position + STEP * np.clip(3 * action, -1, 1), -1, 1).astype(np.float32)


def batches(seed: int) -> Batch:
    """Return batches ``(UPDATES, BATCH, ...)`` of random walks, with goals relabelled in hindsight.

    Half of the goals are states of any walk, half later states of the same walk.
    """
    rng = np.random.default_rng(seed)
    walks, length = 1000, 20
    states = [rng.uniform(-1, 1, (walks, 1)).astype(np.float32)]
    actions = rng.uniform(-1, 1, (length, walks, 1)).astype(np.float32)
    for action in actions:
        states.append(move(states[-1], action))
    states = np.stack(states)  # (length + 1, walks, 1)

    shape = (UPDATES, BATCH)
    walk, time = rng.integers(walks, size=shape), rng.integers(length, size=shape)
    later = rng.integers(time + 1, length + 1)
    any_state = states[rng.integers(length + 1, size=shape), rng.integers(walks, size=shape)]
    goal = np.where(rng.random((*shape, 1)) < 0.5, any_state, states[later, walk])
    next_observation = states[time + 1, walk]
    reward, terminated = TASK(next_observation, goal)
    candidate = states[rng.integers(length, size=shape), rng.integers(walks, size=shape)]
    batch = Batch(
        observation=states[time, walk],
        action=actions[time, walk],
        reward=reward,
        terminated=terminated,
        next_observation=next_observation,
        goal=goal,
        subgoal_candidate=Subgoal(candidate, candidate),
    )
    return jax.tree.map(jnp.asarray, batch)


def train(agent: Any, seed: int) -> Any:
    start = agent.create(CONFIGS[agent], SPEC, jax.random.key(seed))
    _, static = eqx.partition(start, eqx.is_array)

    @jax.jit
    def run(arrays, batches, keys):
        def step(arrays, inputs):
            state, _ = agent.update(eqx.combine(arrays, static), *inputs)
            return eqx.filter(state, eqx.is_array), None

        return jax.lax.scan(step, arrays, (batches, keys))[0]

    keys = jax.random.split(jax.random.key(seed), UPDATES)
    return eqx.combine(run(eqx.filter(start, eqx.is_array), batches(seed), keys), static)


@functools.cache
def trained(agent: Any) -> Any:
    return train(agent, seed=0)


both = pytest.mark.parametrize("agent", [ris, sac], ids=["ris", "sac"])


def pairs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states and goals that are not reached yet, and the steps needed between them."""
    rng = np.random.default_rng(1)
    observation, goal = rng.uniform(-1, 1, (2, 500, 1)).astype(np.float32)
    steps = np.ceil((np.abs(observation - goal) - THRESHOLD) / STEP)[:, 0]
    apart = steps > 0
    return observation[apart], goal[apart], steps[apart]


@both
def test_greedy_policy_reaches_goals_by_the_shortest_way(agent):
    observation, goal, steps = pairs()
    act = eqx.filter_jit(agent.act)
    taken = np.full(len(steps), np.inf)
    for i in range(1, SPEC.max_episode_steps + 1):
        positions = jnp.asarray(observation), jnp.asarray(goal)
        actions = act(trained(agent), *positions, jax.random.key(0), False)
        observation = move(observation, np.asarray(actions))
        taken = np.where(TASK(observation, goal)[1], np.minimum(taken, i), taken)
    assert np.isfinite(taken).mean() >= 0.95
    assert (taken <= steps + 1).mean() >= 0.95


@both
def test_values_are_the_discounted_number_of_steps(agent):
    state = trained(agent)
    observation, goal, steps = pairs()
    positions = jnp.asarray(observation), jnp.asarray(goal)
    action = jnp.tanh(state.policy(*positions).mean)
    learned = state.critic(positions[0], action, positions[1]).min(0)
    known = -(1 - DISCOUNT**steps) / (1 - DISCOUNT)
    assert np.ptp(known) > 10
    assert np.corrcoef(learned, known)[0, 1] > 0.98
    # A smooth network cannot follow the rounding of d, which alone is a quarter of a step.
    assert np.abs(learned - known).mean() < 0.6


def test_imagined_subgoals_lie_midway():
    observation, goal, _ = pairs()
    apart = np.abs(observation - goal)[:, 0] > 0.4
    observation, goal = observation[apart], goal[apart]

    def from_midpoint(subgoal) -> float:
        return np.abs(np.asarray(subgoal) - (observation + goal) / 2).mean()

    def imagined(state) -> np.ndarray:
        positions = jnp.asarray(observation), jnp.asarray(goal)
        return np.asarray(state.subgoal_policy(*positions).location)

    subgoal, tolerance = imagined(trained(ris)), 0.06
    assert from_midpoint(subgoal) < tolerance
    share = (subgoal - observation) / (goal - observation)
    assert ((share > 0.25) & (share < 0.75)).mean() > 0.95
    # Subgoal policies that have learned nothing, or the wrong thing, are far outside.
    untrained = ris.create(CONFIGS[ris], SPEC, jax.random.key(0))
    for wrong in (imagined(untrained), observation, goal, 0 * goal):
        assert from_midpoint(wrong) > 3 * tolerance
