"""Interquartile mean, intervals and curves against numbers worked by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from midway.statistics import (
    Scores,
    Series,
    bootstrap,
    curve,
    improvement,
    interquartile_mean,
    of_agent,
    of_policy,
    of_runs,
    performance_profile,
    wilson,
)

SHARES = st.floats(0, 1, width=32)


def column(*values):
    return np.array(values, np.float64)[:, None]


def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ((7,), 7),
        ((0, 1), 1 / 2),
        ((0, 0, 1), 1 / 3),  # floor(3 / 4) = 0 are left out at each end
        ((0, 2, 4, 100), 3),
        ((1, 0, 0.4, 0.6, 0.2), 0.4),  # without 0 and 1
        ((8, 1, 6, 2, 5, 3, 4, 7), 4.5),  # without 1, 2 and 7, 8
    ],
)
def test_interquartile_mean(values, mean):
    assert interquartile_mean(column(*values))[0] == pytest.approx(mean)


def test_interquartile_mean_takes_points_apart():
    values = np.array([[0, 10], [2, 30], [4, 20], [100, 0]], np.float64)
    assert interquartile_mean(values).tolist() == [3, 15]


@given(arrays(np.float64, st.tuples(st.integers(1, 12), st.just(2)), elements=SHARES))
def test_interquartile_mean_is_between_the_runs_and_ignores_their_order(values):
    mean = interquartile_mean(values)
    assert (values.min(0) - 1e-12 <= mean).all()
    assert (mean <= values.max(0) + 1e-12).all()
    np.testing.assert_allclose(interquartile_mean(values[::-1]), mean, atol=1e-12)


def scores(*values, episodes=None):
    counted = None if episodes is None else np.full((len(values), 1), float(episodes))
    return Scores(column(*values), counted)


def test_equal_values_that_are_no_rates_have_no_interval():
    interval = bootstrap([scores(0.3, 0.3, 0.3)], rng())
    assert interval.low == pytest.approx([0.3])
    assert interval.high == pytest.approx([0.3])


def test_equal_seeds_have_an_interval_of_their_episodes():
    """A sweep of two seeds is not certain of 60 %, nor of 100 %."""
    found = of_agent([0.6, 0.6], [20, 20])
    assert f"{found:.0%}" == "60% [46%, 74%]"
    pooled = of_policy(0.6, 40)
    assert (found.low, found.high) == pytest.approx((pooled.low, pooled.high), abs=0.02)
    assert f"{of_agent([1.0, 1.0], [20, 20]):.0%}" == "100% [91%, 100%]"
    assert f"{of_agent([0.0, 0.0], [20, 20]):.0%}" == "0% [0%, 8%]"


def test_one_seed_has_the_interval_of_its_policy():
    assert of_agent([0.85], [20]) == pytest.approx(of_policy(0.85, 20))
    assert of_runs([scores(0.3)]) == ([0.3], ([0.3], [0.3]))


def test_interval_of_two_runs():
    """Two draws of 0 and 1 have the mean 0, 1/2, 1 with probability 1/4, 1/2, 1/4."""
    for confidence, low, high in ((0.95, 0, 1), (0.6, 0, 1), (0.4, 0.5, 0.5)):
        interval = bootstrap([scores(0, 1)], rng(), confidence=confidence)
        assert (interval.low[0], interval.high[0]) == (low, high)


def test_runs_are_drawn_inside_their_stratum():
    """The mean of 0, 0, 1, 1 without one at each end is always 1/2 if no run changes sides."""
    interval = bootstrap([scores(0, 0), scores(1, 1)], rng())
    assert (interval.low[0], interval.high[0]) == (0.5, 0.5)
    together = bootstrap([scores(0, 0, 1, 1)], rng())
    assert together.low[0] == 0
    assert together.high[0] == 1


def test_interval_does_not_depend_on_the_order_of_points():
    values = np.array([[0, 1], [1, 0], [0.5, 0.5]], np.float64)
    interval = bootstrap([Scores(values)], rng())
    assert (interval.low <= interquartile_mean(values)).all()
    assert (interval.high >= interquartile_mean(values)).all()


def test_wilson_interval():
    """With z = 1.95996: of n successes in n the lower end is n / (n + z²)."""
    assert wilson(1.0, 10) == pytest.approx((10 / 13.841459, 1))
    assert wilson(0.0, 4) == pytest.approx((0, 3.841459 / 7.841459), abs=1e-6)
    for successes, episodes in ((5, 10), (1, 20), (847, 1000)):
        expected = stats.binomtest(successes, episodes).proportion_ci(method="wilson")
        found = wilson(successes / episodes, episodes)
        assert found == pytest.approx((expected.low, expected.high))


# --- the definitions of rliable, written out as its documentation words them ---------------------


RUNS = st.tuples(st.integers(1, 6), st.integers(1, 3))
RATES = st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])
"""Few values, so that there are ties."""


@settings(max_examples=20)
@given(RUNS, st.integers(1, 6), st.data())
def test_aggregates_are_those_of_rliable(shape, others, data):
    """Of tables ``(runs, tasks)``, as rliable takes them."""
    ours = data.draw(arrays(np.float64, shape, elements=RATES))
    theirs = data.draw(arrays(np.float64, (others, shape[1]), elements=RATES))
    flat = np.sort(ours.ravel())
    cut = int(len(flat) * 0.25)
    strata = [Scores(task[:, None], np.full((len(task), 1), 20.0)) for task in ours.T]
    centre, interval = of_runs(strata)
    assert centre[0] == pytest.approx(flat[cut : len(flat) - cut].mean())
    assert interval.low[0] <= centre[0] <= interval.high[0]

    levels = np.array([0.0, 0.3, 0.5, 0.99, 1.0])
    share, band = performance_profile(strata, levels)
    assert share.tolist() == pytest.approx([np.mean(ours > level) for level in levels])
    assert (band.low <= share).all()
    assert (share <= band.high).all()

    probability = np.mean(
        [
            stats.mannwhitneyu(x, y, alternative="greater").statistic / (len(x) * len(y))
            for x, y in zip(ours.T, theirs.T, strict=True)
        ]
    )
    found = improvement(list(zip(ours.T, theirs.T, strict=True)))
    assert found.centre == pytest.approx(probability)
    assert 0 <= found.low <= found.centre <= found.high <= 1


def test_few_runs_are_never_certain_who_is_better():
    """Of one pair the interval is Wilson's of one trial; that of five against five tells."""
    one = improvement([(np.array([1.0]), np.array([0.0]))])
    assert (one.low, one.high) == pytest.approx((1 / (1 + 3.841459), 1))
    assert improvement([(np.ones(2), np.zeros(2))]).low < 0.5
    assert improvement([(np.ones(5), np.zeros(5))]).low > 0.6
    equal = improvement([(np.ones(3), np.ones(3))])
    assert (equal.centre, equal.low + equal.high) == pytest.approx((0.5, 1))


def test_several_environments_say_more_than_one():
    """Of four equal ones each end is half as far from the centre."""
    ours, theirs = np.array([0.9, 1.0]), np.array([0.2, 0.95])
    one, four = improvement([(ours, theirs)]), improvement(4 * [(ours, theirs)])
    assert one.centre == four.centre == 0.75
    assert four.centre - four.low == pytest.approx((one.centre - one.low) / 2)


# --- curves ---------------------------------------------------------------------------------------


def test_curve_counts_runs_where_they_are():
    long = np.array([0.0, 2.0, 4.0]), np.array([0.0, 0.2, 0.4])
    short = np.array([1.0, 2.0]), np.array([0.5, 0.6])
    drawn = curve([[Series(*long), Series(*short)]], np.array([0.0, 1.0, 2.0, 4.0]))
    assert drawn.runs.tolist() == [1, 2, 2, 1]
    assert drawn.centre == pytest.approx([0, (0.1 + 0.5) / 2, (0.2 + 0.6) / 2, 0.4])
    assert drawn.interval.low == pytest.approx([0, 0.1, 0.2, 0.4])
    assert drawn.interval.high == pytest.approx([0, 0.5, 0.6, 0.4])


def test_curve_of_several_environments_is_where_all_have_a_run():
    early = np.array([1.0, 2.0]), np.array([0.0, 0.0])
    late = np.array([2.0, 3.0]), np.array([1.0, 1.0])
    drawn = curve([[Series(*early)], [Series(*late)]], np.array([1.0, 2.0, 3.0]))
    assert drawn.x.tolist() == [2]
    assert drawn.centre.tolist() == [0.5]
    assert drawn.runs.tolist() == [2]


def test_a_curve_of_success_counts_episodes():
    steps, rates = np.array([0.0, 10.0]), np.array([0.0, 0.5])
    one = Series(steps, rates, np.array([20.0, 100.0]))
    alone = curve([[one]], steps)
    low, high = wilson(rates, np.array([20.0, 100.0]))
    np.testing.assert_allclose(alone.interval, (low, high))
    both = curve([[one, one]], steps)
    assert (both.interval.high - both.interval.low > 0.02).all()
