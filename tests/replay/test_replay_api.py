from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from replay_reference import (
    BATCH,
    IMAGE,
    PAIR,
    SIZES,
    SPECS,
    VECTOR,
    Reference,
    add,
    begin,
    sample,
)

from midway.errors import ConfigurationError
from midway.replay import buffer
from midway.replay.buffer import create, memory_bytes, num_transitions
from midway.replay.relabel import source_counts
from midway.types import DistanceTask, EnvSpec, RelabelMix, Sampling

TASK = DistanceTask(groups=((0, 1),), threshold=0.5)
ANT = EnvSpec("ant-u", (31,), "float32", (31,), 8, 600, True, None, TASK)
PUSH = EnvSpec("push", (84, 84, 3), "uint8", (84, 84, 3), 2, 100, True, (4,), TASK)
GIB = 2**30


def filled(spec, steps=3):
    num_lanes, lane_rows = SIZES[1]
    reference = Reference(spec, num_lanes, lane_rows)
    mask = np.ones(num_lanes, bool)
    replay = begin(create(spec, num_lanes * lane_rows, num_lanes), reference.begin(mask), mask)
    for _ in range(steps):
        replay = add(replay, *reference.add(mask), mask)
    return replay, reference


@pytest.mark.parametrize(
    ("shares", "batch_size", "counts"),
    [
        ((0.2, 0.4, 0.4), 2048, (409, 819, 820)),
        ((0.2, 0.4, 0.4), 256, (51, 102, 103)),
        ((0.0, 0.0, 1.0), 7, (0, 0, 7)),
        ((0.5, 0.5, 0.0), 7, (3, 4, 0)),
        ((0.0, 1.0, 0.0), 7, (0, 7, 0)),
        ((1.0, 0.0, 0.0), 7, (7, 0, 0)),
        ((0.3, 0.7, 0.0), 1, (0.0, 1.0, 0.0)),
    ],
)
def test_source_counts(shares, batch_size, counts):
    assert source_counts(RelabelMix(*shares), batch_size) == counts


@pytest.mark.parametrize("shares", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_batch_of_one_source(shares):
    replay, reference = filled(VECTOR)
    batch = sample(replay, VECTOR, RelabelMix(*shares), seed=0)
    assert batch.goal.shape == (BATCH, 3)
    assert np.all((batch.goal[:, 2] == 1000) == (shares[0] == 1))
    assert int(num_transitions(replay)) == len(reference.transitions()) == 9


def test_a_failure_ends_the_value_of_its_last_step_alone():
    """Also where n-step returns reach it, and in the episode that overwrites its rows."""
    task = DistanceTask(groups=((0,),), threshold=0.5)
    spec = EnvSpec("x", (1,), "float32", (1,), 1, 3, True, None, task, can_fail=True)
    everyone = np.ones(1, bool)
    replay = create(spec, 10, 1)
    for fails in (True, False, False):
        shown = {"observation": np.zeros((1, 1)), "desired_goal": np.full((1, 1), 9.0)}
        replay = begin(replay, shown, everyone)
        for step in (1, 2, 3):
            here = {
                "observation": np.full((1, 1), float(step)),
                "failed": everyone & fails & (step == 3),
            }
            replay = add(replay, np.zeros((1, 1)), here, everyone)
        batch = sample(replay, spec, RelabelMix(1.0, 0.0, 0.0), seed=0)
        if fails:
            last = np.asarray(batch.next_observation[:, 0]) == 3
            np.testing.assert_array_equal(batch.failed, last)
            np.testing.assert_array_equal(batch.terminated, last)
            far = sample(replay, spec, RelabelMix(1.0, 0.0, 0.0), seed=0, wanted=Sampling(n_step=3))
            np.testing.assert_array_equal(far.failed, np.ones(BATCH, bool))
            reached = sample(replay, spec, RelabelMix(0.0, 0.0, 1.0), seed=0)
            there = np.asarray(reached.goal == reached.next_observation)[:, 0]
            assert not (np.asarray(reached.failed) & there).any()
    assert not np.asarray(batch.failed).any()


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_shapes_and_dtypes(spec):
    replay, _ = filled(spec)
    batch = sample(replay, spec, RelabelMix(), seed=0)
    goal_dtype = "uint8" if spec is IMAGE else "float32"
    assert (
        batch.observation.shape == batch.next_observation.shape == (BATCH, *spec.observation_shape)
    )
    assert batch.observation.dtype == batch.next_observation.dtype == spec.observation_dtype
    assert (
        batch.goal.shape == batch.subgoal_candidate.achieved_goal.shape == (BATCH, *spec.goal_shape)
    )
    assert batch.goal.dtype == batch.subgoal_candidate.achieved_goal.dtype == goal_dtype
    assert batch.action.shape == (BATCH, spec.action_dim)
    assert batch.reward.shape == batch.terminated.shape == (BATCH,)


def test_each_content_is_stored_once():
    assert set(create(VECTOR, 12, 1).rows) == {"observation", "action"}
    assert set(create(PAIR, 12, 1).rows) == {"observation", "action", "achieved_goal"}
    assert set(create(IMAGE, 12, 1).rows) == {"observation", "action", "achieved_state"}


def test_masked_off_lanes_are_untouched():
    replay, reference = filled(VECTOR)
    mask = np.array([False, True, False])
    for after in (
        begin(replay, reference.begin(mask), mask),
        add(replay, *reference.add(mask), mask),
    ):
        for old, new in zip(jax.tree.leaves(replay), jax.tree.leaves(after), strict=True):
            np.testing.assert_array_equal(old[0], new[0])
            np.testing.assert_array_equal(old[2], new[2])
        assert int(after.num_rows[1]) > int(replay.num_rows[1])


def test_lane_without_episode_takes_no_step():
    empty = create(VECTOR, 12, 1)
    mask = np.ones(1, bool)
    after = add(empty, *Reference(VECTOR, 1, 12).add(mask), mask)
    assert all(map(np.array_equal, jax.tree.leaves(empty), jax.tree.leaves(after)))


def test_empty_replay_counts_no_transitions_and_sampling_it_ends():
    replay = create(VECTOR, 72, 3)
    assert int(num_transitions(replay)) == 0
    sample(replay, VECTOR, RelabelMix(), seed=0)
    replay, _ = filled(VECTOR, steps=0)
    assert int(num_transitions(replay)) == 0
    sample(replay, VECTOR, RelabelMix(), seed=0)


def test_restored_arrays_continue_the_same_run():
    replay, reference = filled(IMAGE)
    leaves, structure = jax.tree.flatten(replay)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    restored = jax.tree.unflatten(structure, [jnp.asarray(np.array(leaf)) for leaf in leaves])
    mask = np.ones(3, bool)
    step = reference.add(mask)
    batches = [
        sample(add(state, *step, mask), IMAGE, RelabelMix(), seed=3) for state in (replay, restored)
    ]
    assert all(map(np.array_equal, *map(jax.tree.leaves, batches)))


def test_one_compilation():
    traces = {"begin": 0, "add": 0, "sample": 0}

    def counted(name, function):
        def call(*arguments):
            traces[name] += 1
            return function(*arguments)

        return jax.jit(call)

    compiled_begin, compiled_add = counted("begin", buffer.begin), counted("add", buffer.add)
    compiled_sample = counted(
        "sample", lambda r, key: buffer.sample(r, VECTOR, RelabelMix(), 16, key)
    )
    reference = Reference(VECTOR, 3, 24)
    replay = create(VECTOR, 72, 3)
    for step in range(40):
        mask = np.array([True, step % 3 == 0, False])
        if step % 4 == 0:
            replay = compiled_begin(replay, reference.begin(mask), mask)
        replay = compiled_add(replay, *reference.add(mask), mask)
        compiled_sample(replay, jax.random.key(step))
    assert traces == {"begin": 1, "add": 1, "sample": 1}


def test_writing_into_a_donated_replay_copies_nothing():
    replay = jax.eval_shape(lambda: create(ANT, 200_000, 4))
    mask = jax.ShapeDtypeStruct((4,), bool)
    row = jax.ShapeDtypeStruct((4, 31), "float32")
    action = jax.ShapeDtypeStruct((4, 8), "float32")
    observation = dict.fromkeys(("observation", "achieved_goal", "desired_goal"), row)

    def step(replay, action, observation, mask):
        replay = buffer.add(replay, action, observation, mask)
        return buffer.begin(replay, observation, mask)

    lowered = jax.jit(step, donate_argnums=0).lower(replay, action, observation, mask)
    memory = lowered.compile().memory_analysis()
    size = memory_bytes(ANT, 200_000, 4)
    assert memory.alias_size_in_bytes == size
    assert memory.temp_size_in_bytes < size / 1000


def test_unused_candidates_cost_nothing():
    replay, _ = filled(VECTOR)

    def compiled(keep):
        def draw(key):
            batch = buffer.sample(replay, VECTOR, RelabelMix(), 16, key)
            return batch if keep else batch._replace(subgoal_candidate=None)

        return jax.jit(draw).lower(jax.random.key(0)).compile().as_text()

    assert compiled(keep=False).count(" gather(") < compiled(keep=True).count(" gather(")


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_memory_is_that_of_the_arrays(spec):
    replay = create(spec, 100, 3)
    assert memory_bytes(spec, 100, 3) == sum(leaf.nbytes for leaf in jax.tree.leaves(replay))


def test_memory_of_the_large_tasks():
    ant_rows = 1_000_000 * 602 // 600
    assert memory_bytes(ANT, ant_rows, 8) < 0.16 * GIB
    push_rows = 100_000 * 102 // 100
    assert memory_bytes(PUSH, push_rows, 8) < 2.02 * GIB


@pytest.mark.parametrize(("capacity", "num_lanes"), [(11, 1), (0, 1), (35, 3), (12, 0), (-1, 1)])
def test_too_small_capacity(capacity, num_lanes):
    with pytest.raises(ConfigurationError, match=r"^replay of .* rows are needed .*$") as error:
        create(VECTOR, capacity, num_lanes)
    assert "\n" not in str(error.value)
    create(VECTOR, 12 * max(num_lanes, 1), max(num_lanes, 1))
    create(replace(VECTOR, max_episode_steps=1), 6, 1)
