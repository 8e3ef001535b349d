"""Replay as pure functions: create, begin, add, withdraw, sample.

All run on the learner's device inside compiled steps. Donate the replay to a compiled ``begin``,
``add`` or ``withdraw``, and the ring is written in place.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from midway.errors import ConfigurationError
from midway.replay.relabel import Rows, draw, goal_rows, source_counts
from midway.replay.storage import (
    ReplayState,
    allocate,
    episode_first,
    insert,
    live,
    num_bytes,
    read,
    write,
)
from midway.types import (
    AnyArray,
    Batch,
    EnvSpec,
    Observation,
    Outcome,
    RelabelMix,
    Sampling,
    Subgoal,
)


def create(spec: EnvSpec, capacity: int, num_lanes: int) -> ReplayState:
    """Return an empty replay.

    Args:
        spec: The environment.
        capacity: Rows over all lanes; an episode of T steps takes T + 2 rows.
        num_lanes: Number of parallel environments K; each writes its own lane.

    Raises:
        ConfigurationError: A lane cannot hold two of the longest episodes.
    """
    _check(spec, capacity, num_lanes)
    return allocate(_row_kinds(spec), num_lanes, capacity // num_lanes)


def begin(replay: ReplayState, observation: Observation, mask: Bool[AnyArray, " K"]) -> ReplayState:
    """Start an episode in each masked lane from the observation ``(K, ...)`` of its reset.

    Writes the goal row and the row of s_0. An episode in which no step was taken is overwritten.
    """
    mask = jnp.asarray(mask)
    lane = jnp.arange(mask.shape[0])
    newest = replay.num_episodes - 1
    newest_first = episode_first(replay, lane, newest)
    # Overwriting leaves every ended episode at least three rows: this bounds the episode table.
    unused = (newest >= 0) & (replay.num_rows - newest_first == 2)
    serial = jnp.where(unused, newest, newest + 1)
    first = jnp.where(unused, newest_first, replay.num_rows)

    replay = write(replay, first, _goal_row(replay, observation), mask)
    replay = write(replay, first + 1, _state_row(replay, observation, jnp.zeros_like(mask)), mask)
    episode = insert(replay.episode, first, serial, mask)
    num_rows = jnp.where(mask, first + 2, replay.num_rows)
    return replay._replace(
        episode=insert(episode, first + 1, serial, mask),
        first=insert(replay.first, serial, first, mask),
        num_rows=num_rows,
        num_episodes=jnp.where(mask, serial + 1, replay.num_episodes),
        written=jnp.maximum(replay.written, num_rows),
    )


def add(
    replay: ReplayState,
    action: Float[AnyArray, "K action_dim"],
    observation: Observation,
    mask: Bool[AnyArray, " K"],
) -> ReplayState:
    """Append one step to the running episode of each masked lane.

    The action goes into the lane's newest row, the observation ``(K, ...)`` after the step becomes
    the next row. Lanes where no episode was begun are left alone. An observation has ``failed``
    where the environment may end an episode without success.
    """
    mask = jnp.asarray(mask) & (replay.num_episodes > 0)
    position = replay.num_rows
    failed = jnp.asarray(observation.get("failed", jnp.zeros_like(mask)))
    replay = write(replay, position - 1, {"action": action}, mask)
    replay = write(replay, position, _state_row(replay, observation, failed), mask)
    return replay._replace(
        episode=insert(replay.episode, position, replay.num_episodes - 1, mask),
        num_rows=position + mask,
        written=jnp.maximum(replay.written, position + mask),
    )


def withdraw(replay: ReplayState, mask: Bool[AnyArray, " K"]) -> ReplayState:
    """Take the newest episode of each masked lane out: nothing of it is drawn any more.

    One that has lost its goal row is left alone: it is not drawn anyway.
    """
    newest = replay.num_episodes - 1
    first = episode_first(replay, jnp.arange(newest.shape[0]), newest)
    is_there = (first < replay.num_rows) & (first >= replay.written - replay.episode.shape[1])
    mask = jnp.asarray(mask) & (newest >= 0) & is_there
    return replay._replace(
        num_rows=jnp.where(mask, first, replay.num_rows),
        num_episodes=jnp.where(mask, newest, replay.num_episodes),
    )


def sample(
    replay: ReplayState,
    spec: EnvSpec,
    mix: RelabelMix,
    batch_size: int,
    key: Key[Array, ""],
    wanted: Sampling | None = None,
) -> Batch:
    """Return transitions drawn uniformly, with relabelled goals, and states as subgoal candidates.

    Reward and terminated are both recomputed for the new goal (appendix B, experience relabelling).
    Candidates are states drawn uniformly and independently of the transitions. There must be at
    least one transition (``num_transitions``); an empty replay gives a batch without meaning.
    """
    wanted = wanted or Sampling()
    draw_key, goal_key = jax.random.split(key)
    _, num_random, _ = source_counts(mix, batch_size)
    has_next = jnp.arange(2 * batch_size + num_random) < batch_size
    pairs, states, others = _split(
        draw(replay, has_next, draw_key), batch_size, batch_size + num_random
    )
    goals = "observation" if spec.goal_is_observation else "achieved_goal"
    truth = goals if spec.state_shape is None else "achieved_state"

    def is_reached(
        lane: Int[Array, " B"], position: Int[Array, " B"], desired: Shaped[Array, "B ..."]
    ) -> Bool[Array, " B"]:
        reached: Bool[Array, " B"] = spec.task(read(replay, truth, lane, position), desired)[1]
        return reached

    current, candidate = (pairs.lane, pairs.position), (others.lane, others.position)
    goal = goal_rows(pairs, states, mix, goal_key)
    if wanted.unreached:
        there = is_reached(*current, read(replay, truth, *goal))
        elsewhere = jax.tree.map(lambda x: jnp.roll(x, 1), candidate)
        goal = jax.tree.map(lambda new, old: jnp.where(there, new, old), elsewhere, goal)
    desired = read(replay, truth, *goal)

    steps = jnp.ones(batch_size, jnp.int32)
    for number in range(1, wanted.n_step):
        done = is_reached(pairs.lane, pairs.position + number, desired)
        more = (steps == number) & ~done & (pairs.position + number < pairs.last)
        steps = steps + more
    following = (pairs.lane, pairs.position + steps)
    outcome = Outcome(read(replay, truth, *following), desired)
    reward, terminated = spec.task(*outcome)
    failed = read(replay, "failed", *following) & ~terminated if spec.can_fail else None
    return Batch(
        observation=read(replay, "observation", *current),
        action=read(replay, "action", *current),
        reward=reward,
        terminated=terminated if failed is None else terminated | failed,
        next_observation=read(replay, "observation", *following),
        goal=read(replay, goals, *goal),
        subgoal_candidate=Subgoal(
            read(replay, "observation", *candidate), read(replay, goals, *candidate)
        ),
        outcome=None if truth == "observation" else outcome,
        steps=steps.astype(jnp.float32) if wanted.n_step > 1 else None,
        failed=failed,
    )


def num_transitions(replay: ReplayState) -> Int[Array, ""]:
    """Return the number of stored transitions that can be drawn."""
    return jnp.sum(live(replay).transitions)


def memory_bytes(spec: EnvSpec, capacity: int, num_lanes: int) -> int:
    """Return the size in bytes of the arrays that ``create`` would allocate.

    Raises:
        ConfigurationError: As ``create``.
    """
    return num_bytes(jax.eval_shape(lambda: create(spec, capacity, num_lanes)))


def _check(spec: EnvSpec, capacity: int, num_lanes: int) -> None:
    """Check that a lane holds two of the longest episodes, so that one is always whole."""
    needed = 2 * (spec.max_episode_steps + 2) * max(num_lanes, 1)
    if num_lanes < 1 or capacity < needed:
        raise ConfigurationError(
            f"replay of {capacity} rows for {num_lanes} environments of {spec.name}: at least one "
            f"environment and {needed} rows are needed (two episodes of "
            f"{spec.max_episode_steps} steps for each)"
        )


def _row_kinds(spec: EnvSpec) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shape and dtype of what one row holds, by name."""
    kinds = {
        "observation": (spec.observation_shape, spec.observation_dtype),
        "action": ((spec.action_dim,), "float32"),
    }
    if not spec.goal_is_observation:
        kinds["achieved_goal"] = (spec.goal_shape, "float32")
    if spec.state_shape is not None:
        kinds["achieved_state"] = (spec.state_shape, "float32")
    if spec.can_fail:
        kinds["failed"] = ((), "bool")
    return kinds


def _state_row(
    replay: ReplayState, observation: Observation, failed: Bool[Array, " K"]
) -> Observation:
    """Return the parts of an observation that the row of a state holds."""
    shown = {**observation, "failed": failed}
    return {name: shown[name] for name in replay.rows if name != "action"}


def _goal_row(replay: ReplayState, observation: Observation) -> Observation:
    """Return the parts of an observation that the goal row holds, where a state holds its own."""
    goals = "achieved_goal" if "achieved_goal" in replay.rows else "observation"
    row = {goals: observation["desired_goal"]}
    if "achieved_state" in replay.rows:
        row["achieved_state"] = observation["desired_state"]
    return row


def _split(rows: Rows, *ends: int) -> list[Rows]:
    """Split drawn rows into blocks at these ends."""
    blocks = zip(*(jnp.split(leaf, ends) for leaf in rows), strict=True)
    return [Rows(*block) for block in blocks]
