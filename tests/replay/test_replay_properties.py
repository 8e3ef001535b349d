import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from replay_reference import (
    SIZES,
    SPECS,
    VECTOR,
    Reference,
    add,
    begin,
    contents,
    names,
    sample,
    withdraw,
)

from midway.replay.buffer import create, num_transitions
from midway.types import RelabelMix

MIX = RelabelMix()
COUNTS = (409, 819, 820)
BEGIN, ADD, WITHDRAW = "begin", "add", "withdraw"


def run(spec, size, operations):
    """The same operations on the replay and on the reference."""
    num_lanes, lane_rows = size
    reference = Reference(spec, num_lanes, lane_rows)
    replay = create(spec, num_lanes * lane_rows, num_lanes)
    for kind, bits in operations:
        mask = (bits >> np.arange(num_lanes)) % 2 == 1
        if kind == BEGIN:
            replay = begin(replay, reference.begin(mask), mask)
        elif kind == ADD:
            replay = add(replay, *reference.add(mask), mask)
        else:
            replay = withdraw(replay, reference.withdraw(mask))
    return replay, reference


def check(spec, reference, batch):
    """Every part of every sample against the lists."""
    transitions, states = reference.transitions(), reference.states()
    pairs, following, goals = map(names, (batch.observation, batch.next_observation, batch.goal))
    candidates = names(batch.subgoal_candidate.observation)
    assert set(pairs) == set(transitions)
    assert set(candidates) == states
    assert candidates == names(batch.subgoal_candidate.achieved_goal)

    source = np.repeat(["own", "random", "future"], COUNTS)
    samples = zip(pairs, batch.action[:, 0].tolist(), following, source, goals, strict=True)
    for pair, action, next_state, kind, goal in set(samples):
        own_goal, episode, t = transitions[pair]
        assert (action, next_state) == (episode[t].action, episode[t + 1].name)
        allowed = {
            "own": {own_goal.name},
            "random": states,
            "future": {row.name for row in episode[t + 1 :]},
        }
        assert goal in allowed[kind]
    check_contents(spec, batch, pairs, goals, source == "own")
    check_rewards(spec, batch, following, goals)
    if spec is VECTOR:
        assert batch.outcome is None
    else:
        assert names(batch.outcome.achieved) == following
        assert names(batch.outcome.desired) == goals


def check_contents(spec, batch, pairs, goals, is_own):
    goal_dtype = spec.observation_dtype if spec.goal_is_observation else "float32"
    observation = contents(spec.observation_shape, spec.observation_dtype, *np.transpose(pairs), 0)
    goal = contents(spec.goal_shape, goal_dtype, *np.transpose(goals), is_own)
    np.testing.assert_array_equal(batch.observation, observation)
    np.testing.assert_array_equal(batch.goal, goal)
    assert (batch.observation.dtype, batch.goal.dtype) == (observation.dtype, goal.dtype)


def check_rewards(spec, batch, following, goals):
    # Contents name their rows in the coordinates that the task measures, so it can be applied to
    # the names: this holds for images too, whose states are not part of the batch.
    reward, terminated = spec.task(
        *(np.array(pairs, np.float32)[:, ::-1] for pairs in (following, goals))
    )
    np.testing.assert_array_equal(batch.reward, reward)
    np.testing.assert_array_equal(batch.terminated, terminated)
    assert (batch.reward.dtype, batch.terminated.dtype) == (np.float32, bool)


def operations(max_size):
    """Mostly steps, so that episodes of all lengths arise; masks as bits."""
    kinds = st.sampled_from([BEGIN, ADD, ADD, ADD, WITHDRAW, BEGIN])
    return st.lists(st.tuples(kinds, st.integers(0, 7)), min_size=2, max_size=max_size)


@pytest.mark.parametrize("name", SPECS)
@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(size=st.sampled_from(SIZES), script=operations(80), seed=st.integers(0, 2**16))
def test_batch_is_what_was_written(name, size, script, seed):
    spec = SPECS[name]
    replay, reference = run(spec, size, script)
    transitions = reference.transitions()
    assert int(num_transitions(replay)) == len(transitions)
    if transitions:
        check(spec, reference, sample(replay, spec, MIX, seed))


@pytest.mark.parametrize("size", SIZES)
@settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(lengths=st.lists(st.integers(0, 4), min_size=10, max_size=40))
@example(lengths=[1] * 39 + [0])  # as many episodes as a lane can hold
def test_wraps_with_whole_episodes(size, lengths):
    # Full-length use: every lane runs episodes one after the other, the ring wraps several times.
    script = [op for length in lengths for op in [(BEGIN, 7)] + [(ADD, 7)] * length]
    replay, reference = run(VECTOR, size, [*script, (ADD, 7)])
    check(VECTOR, reference, sample(replay, VECTOR, MIX, seed=0))
    if sum(lengths) > 2 * size[1]:
        # Two of the longest episodes fit, so one whole episode at least is always drawable.
        assert len(reference.transitions()) >= 1


def test_every_slot_is_drawn_at_some_time():
    size = num_lanes, lane_rows = SIZES[1]
    generator = np.random.default_rng(0)
    script, seen = [(BEGIN, 7)], set()
    for _ in range(40):
        script += [(ADD, 7)] * generator.integers(1, 5) + [(BEGIN, 7)]
        replay, reference = run(VECTOR, size, script)
        drawn = set(names(sample(replay, VECTOR, MIX, seed=0).observation))
        for lane, rows in enumerate(reference.lanes):
            seen |= {(lane, i % lane_rows) for i, row in enumerate(rows) if row.name in drawn}
    assert len(seen) == num_lanes * lane_rows


def test_episode_longer_than_its_lane_is_dropped():
    script = [(BEGIN, 1)] + [(ADD, 1)] * 30
    for last in ([], [(WITHDRAW, 1)]):
        replay, reference = run(VECTOR, (1, 12), script + last)
        assert reference.transitions() == {}
        assert int(num_transitions(replay)) == 0


def test_withdrawn_episodes_are_drawn_no_more_and_what_they_overwrote_is_gone():
    episode = [(BEGIN, 7)] + [(ADD, 7)] * 3
    # The third episode is withdrawn; its last row has overwritten the goal row of the first.
    script = [*episode, *episode, (BEGIN, 1), (ADD, 1), (WITHDRAW, 1), (BEGIN, 1), (ADD, 1)]
    for length, transitions in ((-3, 4), (-2, 3), (len(script), 4)):
        replay, reference = run(VECTOR, SIZES[0], script[:length])
        assert len(reference.transitions()) == transitions
        check(VECTOR, reference, sample(replay, VECTOR, MIX, seed=0))
