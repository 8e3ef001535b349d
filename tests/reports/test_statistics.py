"""Interquartile mean, intervals and curves against numbers worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from midway.reports.statistics import bootstrap, curve, interquartile_mean, wilson

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


def test_equal_runs_have_no_interval():
    interval = bootstrap([column(0.3, 0.3, 0.3)], rng())
    assert interval.low == pytest.approx([0.3])
    assert interval.high == pytest.approx([0.3])


def test_one_run_has_no_interval():
    assert bootstrap([column(0.3)], rng()) == ([0.3], [0.3])


def test_interval_of_two_runs():
    """Two draws of 0 and 1 have the mean 0, 1/2, 1 with probability 1/4, 1/2, 1/4."""
    for confidence, low, high in ((0.95, 0, 1), (0.6, 0, 1), (0.4, 0.5, 0.5)):
        interval = bootstrap([column(0, 1)], rng(), confidence=confidence)
        assert (interval.low[0], interval.high[0]) == (low, high)


def test_runs_are_drawn_inside_their_stratum():
    """The mean of 0, 0, 1, 1 without one at each end is always 1/2 if no run changes sides."""
    interval = bootstrap([column(0, 0), column(1, 1)], rng())
    assert (interval.low[0], interval.high[0]) == (0.5, 0.5)
    together = bootstrap([column(0, 0, 1, 1)], rng())
    assert together.low[0] == 0
    assert together.high[0] == 1


def test_interval_does_not_depend_on_the_order_of_points():
    values = np.array([[0, 1], [1, 0], [0.5, 0.5]], np.float64)
    interval = bootstrap([values], rng())
    assert (interval.low <= interquartile_mean(values)).all()
    assert (interval.high >= interquartile_mean(values)).all()


def test_wilson_interval():
    """With z = 1.95996: of n successes in n the lower end is n / (n + z²)."""
    assert wilson(10, 10) == pytest.approx((10 / 13.841459, 1))
    assert wilson(0, 4) == pytest.approx((0, 3.841459 / 7.841459), abs=1e-6)
    assert wilson(5, 10) == pytest.approx((0.2365931, 0.7634069))


def test_curve_counts_runs_where_they_are():
    long = np.array([0.0, 2.0, 4.0]), np.array([0.0, 0.2, 0.4])
    short = np.array([1.0, 2.0]), np.array([0.5, 0.6])
    drawn = curve([[long, short]], np.array([0.0, 1.0, 2.0, 4.0]))
    assert drawn.runs.tolist() == [1, 2, 2, 1]
    assert drawn.centre == pytest.approx([0, (0.1 + 0.5) / 2, (0.2 + 0.6) / 2, 0.4])
    assert drawn.interval.low == pytest.approx([0, 0.1, 0.2, 0.4])
    assert drawn.interval.high == pytest.approx([0, 0.5, 0.6, 0.4])


def test_curve_of_several_environments_is_where_all_have_a_run():
    early = np.array([1.0, 2.0]), np.array([0.0, 0.0])
    late = np.array([2.0, 3.0]), np.array([1.0, 1.0])
    drawn = curve([[early], [late]], np.array([1.0, 2.0, 3.0]))
    assert drawn.x.tolist() == [2]
    assert drawn.centre.tolist() == [0.5]
    assert drawn.runs.tolist() == [2]
