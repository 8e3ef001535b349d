"""Interquartile mean over runs, with stratified bootstrap intervals (Agarwal et al., 2021)."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

Run: TypeAlias = tuple[Float[np.ndarray, " ..."], Float[np.ndarray, " ..."]]
"""Points (x, y) of one run."""

RESAMPLES = 2_000
CONFIDENCE = 0.95


class Interval(NamedTuple):
    """Ends of a confidence interval at each point."""

    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]


class Curve(NamedTuple):
    """The interquartile mean of several runs along x.

    Attributes:
        x: Steps or seconds.
        centre: Interquartile mean of the runs that reach x.
        interval: Its bootstrap interval; equal to the centre where fewer than two runs reach x.
        runs: How many runs reach x.
    """

    x: Float[np.ndarray, " points"]
    centre: Float[np.ndarray, " points"]
    interval: Interval
    runs: Int[np.ndarray, " points"]


def interquartile_mean(
    values: Float[np.ndarray, "*batch runs points"],
) -> Float[np.ndarray, "*batch points"]:
    """Return the mean over runs without the lowest and the highest quarter.

    Of n runs, the floor of n / 4 are left out at each end: none of 3, one of 5, two of 10.
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=-2))


def bootstrap(
    strata: Sequence[Float[np.ndarray, "... points"]],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Interval:
    """Return the percentile interval of the interquartile mean of all strata together.

    Args:
        strata: The runs of each environment, ``(runs, points)``; runs are drawn anew, with
            replacement, inside each stratum.
        rng: Source of the draws.
        resamples: Number of draws.
        confidence: Share of the draws inside the interval.
    """
    drawn = [runs[rng.integers(len(runs), size=(resamples, len(runs)))] for runs in strata]
    means = interquartile_mean(np.concatenate(drawn, axis=1))
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(means, [tail, 100 - tail], axis=0)
    return Interval(low, high)


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate that was measured on so many episodes."""
    result = stats.binomtest(successes, episodes).proportion_ci(CONFIDENCE, method="wilson")
    return float(result.low), float(result.high)


def curve(strata: Sequence[Sequence[Run]], x: Float[np.ndarray, " points"]) -> Curve:
    """Return the interquartile mean of runs along x.

    Args:
        strata: The runs of each environment. A run counts between its first and its last point,
            with straight lines between its points.
        x: Points of the curve; those that some environment has no run at are left out.
    """
    values = [
        np.stack([np.interp(x, *run, left=np.nan, right=np.nan) for run in runs]) for runs in strata
    ]
    kept = np.all([np.isfinite(stratum).any(axis=0) for stratum in values], axis=0)
    values = [stratum[:, kept] for stratum in values]
    reached = np.isfinite(np.concatenate(values))
    centre, low, high = np.empty((3, kept.sum()))
    rng = np.random.default_rng(0)
    for present in np.unique(reached, axis=1).T:
        points = (reached == present[:, None]).all(axis=0)
        chosen = [v[:, points][np.isfinite(v[:, points]).all(axis=1)] for v in values]
        centre[points] = interquartile_mean(np.concatenate(chosen))
        low[points], high[points] = bootstrap(chosen, rng)
    return Curve(x[kept], centre, Interval(low, high), reached.sum(axis=0))
