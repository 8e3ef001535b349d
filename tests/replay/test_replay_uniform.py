from collections import Counter

import numpy as np
import pytest
from replay_reference import BATCH, SIZES, VECTOR, Reference, add, begin, names, sample
from scipy.stats import chisquare

from midway.replay.buffer import create
from midway.types import RelabelMix

NUM_LANES, LANE_ROWS = SIZES[1]
REPEATS = 20
SMALLEST_P = 1e-3


@pytest.fixture(scope="module")
def filled():
    """One wrapped lane, one half full, one with the start of an episode; lengths from 1 to 4."""
    reference = Reference(VECTOR, NUM_LANES, LANE_ROWS)
    replay = create(VECTOR, NUM_LANES * LANE_ROWS, NUM_LANES)
    for steps, lanes in [(3, 0), (1, 0), (4, 0), (2, 0), (4, 0), (4, 0), (1, 1), (4, 1), (1, 2)]:
        mask = np.arange(NUM_LANES) == lanes
        replay = begin(replay, reference.begin(mask), mask)
        for _ in range(steps):
            replay = add(replay, *reference.add(mask), mask)
    return replay, reference


def draws(replay, mix):
    """Many batches: (transition, goal, candidate) names."""
    for seed in range(REPEATS):
        batch = sample(replay, VECTOR, mix, seed)
        yield from zip(
            *map(names, (batch.observation, batch.goal, batch.subgoal_candidate.observation)),
            strict=True,
        )


def assert_uniform(names, support):
    counts = Counter(names)
    assert set(counts) == set(support)
    if len(support) > 1:
        assert chisquare([counts[name] for name in support]).pvalue > SMALLEST_P


def test_transitions_candidates_and_random_goals_are_uniform(filled):
    replay, reference = filled
    pairs, goals, candidates = zip(*draws(replay, RelabelMix(0.0, 1.0, 0.0)), strict=True)
    assert_uniform(pairs, list(reference.transitions()))
    assert_uniform(goals, sorted(reference.states()))
    assert_uniform(candidates, sorted(reference.states()))


def test_draws_of_a_batch_element_are_independent(filled):
    replay, reference = filled
    pairs, goals, candidates = zip(*draws(replay, RelabelMix(0.0, 1.0, 0.0)), strict=True)
    states = sorted(reference.states())
    for first, second in [(pairs, goals), (pairs, candidates), (goals, candidates)]:
        given = max(reference.transitions())
        assert_uniform([b for a, b in zip(first, second, strict=True) if a == given], states)


def test_future_goals_are_uniform_over_the_rest_of_the_episode(filled):
    replay, reference = filled
    drawn = list(draws(replay, RelabelMix(0.0, 0.0, 1.0)))
    for name, (_, episode, t) in reference.transitions().items():
        goals = [goal for pair, goal, _ in drawn if pair == name]
        later = [row.name for row in episode[t + 1 :]]
        assert_uniform(goals, later)


def test_sources_do_not_depend_on_the_transition(filled):
    replay, reference = filled
    drawn = list(draws(replay, RelabelMix()))
    own, random = 409, 819
    for start, stop in [(0, own), (own, own + random), (own + random, BATCH)]:
        pairs = [pair for i, (pair, _, _) in enumerate(drawn) if start <= i % BATCH < stop]
        assert_uniform(pairs, list(reference.transitions()))
