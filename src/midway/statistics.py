"""Success rates of policies and agents with their intervals: the one place for both.

References:
    Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021.
    Newcombe, "Confidence intervals for an effect size measure based on the Mann-Whitney statistic.
    Part 2", 2006.
    Zou and Donner, "Construction of confidence limits about effect measures", 2008.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, special, stats

RESAMPLES = 2_000
CONFIDENCE = 0.95
PRIOR = 0.5
"""Successes and failures added before episodes are drawn anew (Jeffreys' prior)."""


class Interval(NamedTuple):
    """Ends of a confidence interval at each point."""

    low: Float[np.ndarray, "*points"]
    high: Float[np.ndarray, "*points"]


class Estimate(NamedTuple):
    """A share and the ends of its 95 % interval; ``.0%`` formats it as ``60% [39%, 78%]``."""

    centre: float
    low: float
    high: float

    def __format__(self, spec: str) -> str:
        """Write all three numbers alike."""
        return f"{self.centre:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"


class Scores(NamedTuple):
    """Results of several runs, each a mean over episodes.

    Attributes:
        values: Success rates, or what else is the mean of a run's episodes.
        episodes: How many episodes each is the mean of; None where the values are no rates of
            successes, so that episodes cannot be drawn anew.
    """

    values: Float[np.ndarray, "..."]
    episodes: Float[np.ndarray, "..."] | None = None


class Series(NamedTuple):
    """Points of one run along x.

    Attributes:
        x: Steps or seconds.
        y: Success rates, or other means over episodes.
        episodes: Episodes of each success rate; None where y are none.
    """

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, " points"]
    episodes: Float[np.ndarray, " points"] | None = None


class Curve(NamedTuple):
    """The interquartile mean of several runs along x.

    Attributes:
        x: Steps or seconds.
        centre: Interquartile mean of the runs that reach x.
        interval: Its interval; equal to the centre where one run reaches x whose values are no
            success rates.
        runs: How many runs reach x.
    """

    x: Float[np.ndarray, " points"]
    centre: Float[np.ndarray, " points"]
    interval: Interval
    runs: Int[np.ndarray, " points"]


# --- one policy -----------------------------------------------------------------------------------


def wilson(
    rate: float | Float[np.ndarray, "*points"],
    episodes: float | int | Float[np.ndarray, "*points"],
) -> Interval:
    """Return the interval of a success rate that was measured on so many episodes (Wilson 1927)."""
    rate, episodes = np.asarray(rate, np.float64), np.asarray(episodes, np.float64)
    z = special.ndtri((1 + CONFIDENCE) / 2)
    middle = rate + z**2 / (2 * episodes)
    spread = z * np.sqrt(rate * (1 - rate) / episodes + (z / (2 * episodes)) ** 2)
    low, high = ((middle + side * spread) / (1 + z**2 / episodes) for side in (-1, 1))
    return Interval(np.where(rate > 0, low, 0.0), np.where(rate < 1, high, 1.0))


def of_policy(rate: float, episodes: float | int) -> Estimate:
    """Return the success rate of one policy on so many episodes with Wilson's interval."""
    low, high = wilson(rate, episodes)
    return Estimate(float(rate), float(low), float(high))


# --- several runs ---------------------------------------------------------------------------------


def interquartile_mean(
    values: Float[np.ndarray, "*batch runs points"],
) -> Float[np.ndarray, "*batch points"]:
    """Return the mean over runs without the lowest and the highest quarter.

    Of n runs, the floor of n / 4 are left out at each end: none of 3, one of 5, two of 10.
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=-2))


def bootstrap(
    strata: Sequence[Scores],
    rng: np.random.Generator,
    statistic: Callable[
        [Float[np.ndarray, "resamples runs points"]], Float[np.ndarray, "resamples others"]
    ] = interquartile_mean,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Interval:
    """Return the percentile interval of a statistic of all strata together.

    Whole runs are drawn anew, with replacement, inside each stratum, and then the episodes of each
    run that was drawn: its success rate is drawn from Jeffreys' posterior, which is not certain
    after any number of episodes without a failure.

    Args:
        strata: The runs of each environment, of as many points.
        rng: Source of the draws.
        statistic: Of the runs of all strata.
        resamples: Number of draws.
        confidence: Share of the draws inside the interval.
    """
    drawn = np.concatenate([_drawn(scores, rng, resamples) for scores in strata], axis=1)
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(statistic(drawn), [tail, 100 - tail], axis=0)
    return Interval(low, high)


def _drawn(
    scores: Scores, rng: np.random.Generator, resamples: int
) -> Float[np.ndarray, "resamples runs points"]:
    """Return draws of the runs of one stratum and of their episodes."""
    runs = len(scores.values)
    chosen = rng.integers(runs, size=(resamples, runs))
    if scores.episodes is None:
        return np.asarray(scores.values[chosen])
    successes = scores.values * scores.episodes
    failures = scores.episodes - successes
    return np.asarray(rng.beta(successes[chosen] + PRIOR, failures[chosen] + PRIOR))


def of_runs(strata: Sequence[Scores]) -> tuple[Float[np.ndarray, " points"], Interval]:
    """Return the interquartile mean of all runs and its interval, which holds it.

    Of one run: Wilson's interval; of several: the stratified bootstrap's over runs and episodes.
    """
    values = np.concatenate([scores.values for scores in strata])
    centre = interquartile_mean(values)
    if len(values) == 1:
        episodes = strata[0].episodes
        return centre, Interval(centre, centre) if episodes is None else wilson(
            values[0], episodes[0]
        )
    low, high = bootstrap(strata, np.random.default_rng(0))
    return centre, Interval(np.minimum(low, centre), np.maximum(high, centre))


def of_agent(rates: Sequence[float], episodes: Sequence[float | int]) -> Estimate:
    """Return the success rate of an agent from those of its runs, with its interval."""
    columns = (np.asarray(each, np.float64)[:, None] for each in (rates, episodes))
    centre, interval = of_runs([Scores(*columns)])
    return Estimate(*(float(each[0]) for each in (centre, *interval)))


def performance_profile(
    strata: Sequence[Scores], thresholds: Float[np.ndarray, " thresholds"]
) -> tuple[Float[np.ndarray, " thresholds"], Interval]:
    """Return the share of runs of more success than each threshold, and its interval.

    Args:
        strata: The runs of each environment, ``(runs, 1)``.
        thresholds: Success rates.
    """

    def above(
        values: Float[np.ndarray, "*batch runs 1"],
    ) -> Float[np.ndarray, "*batch thresholds"]:
        return np.asarray((values > thresholds).mean(axis=-2))

    share = above(np.concatenate([scores.values for scores in strata]))
    low, high = bootstrap(strata, np.random.default_rng(0), above)
    return share, Interval(np.minimum(low, share), np.maximum(high, share))


# --- two agents -----------------------------------------------------------------------------------


def improvement(
    strata: Sequence[tuple[Float[np.ndarray, " ours"], Float[np.ndarray, " theirs"]]],
) -> Estimate:
    """Return the probability that a run of ours is better than one of theirs, ties as one half.

    It is the mean over environments of Mann and Whitney's statistic. Its interval counts runs,
    whose success rates vary by their episodes too: Newcombe's of each environment (his method 5),
    put together as Zou and Donner do. A bootstrap would be certain as soon as all of two runs are
    better than all of two others, which happens to equal agents once in three times.

    Args:
        strata: Success rates of the runs of both, for each environment.
    """
    found = [_improvement(ours, theirs) for ours, theirs in strata]
    centre = float(np.mean([each.centre for each in found]))
    below, above = (
        float(np.linalg.norm([each.centre - each[end] for each in found])) / len(found)
        for end in (1, 2)
    )
    return Estimate(centre, max(0.0, centre - below), min(1.0, centre + above))


def _improvement(
    ours: Float[np.ndarray, " ours"], theirs: Float[np.ndarray, " theirs"]
) -> Estimate:
    """Return the probability of improvement in one environment."""
    centre = float(np.mean((1 + np.sign(ours[:, None] - theirs[None, :])) / 2))
    z, pairs = special.ndtri((1 + CONFIDENCE) / 2), len(ours) * len(theirs)
    more = (len(ours) + len(theirs)) / 2 - 1

    def outside(share: float) -> float:
        """Return how far a share is outside of the interval, below 0 inside."""
        spread = share * (1 - share) / pairs
        spread *= 1 + more * ((1 - share) / (2 - share) + share / (1 + share))
        return float((centre - share) ** 2 - z**2 * spread)

    low = 0.0 if centre == 0 else optimize.brentq(outside, 0, centre * (1 - 1e-9))
    high = 1.0 if centre == 1 else optimize.brentq(outside, centre + (1 - centre) * 1e-9, 1)
    return Estimate(centre, float(low), float(high))


# --- curves ---------------------------------------------------------------------------------------


def curve(strata: Sequence[Sequence[Series]], x: Float[np.ndarray, " points"]) -> Curve:
    """Return the interquartile mean of runs along x.

    Args:
        strata: The runs of each environment. A run counts between its first and its last point,
            with straight lines between its points.
        x: Points of the curve; those that some environment has no run at are left out.
    """
    values = [np.stack([_along(x, run.x, run.y) for run in runs]) for runs in strata]
    counts = [_episodes(runs, x) for runs in strata]
    kept = np.all([np.isfinite(stratum).any(axis=0) for stratum in values], axis=0)
    reached = np.isfinite(np.concatenate(values))[:, kept]
    centre, low, high = np.empty((3, len(x)))
    for present in np.unique(reached, axis=1).T:
        points = kept.copy()
        points[kept] = (reached == present[:, None]).all(axis=0)
        chosen = [_present(*each, points) for each in zip(values, counts, strict=True)]
        centre[points], (low[points], high[points]) = of_runs(chosen)
    ends = Interval(low[kept], high[kept])
    return Curve(x[kept], centre[kept], ends, reached.sum(axis=0))


def _along(
    x: Float[np.ndarray, " points"],
    places: Float[np.ndarray, " own"],
    values: Float[np.ndarray, " own"],
) -> Float[np.ndarray, " points"]:
    return np.asarray(np.interp(x, places, values, left=np.nan, right=np.nan))


def _episodes(
    runs: Sequence[Series], x: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "runs points"] | None:
    """Return the episodes of each run along x; None where the values are no success rates."""
    columns = [_along(x, run.x, run.episodes) for run in runs if run.episodes is not None]
    return np.stack(columns) if len(columns) == len(runs) else None


def _present(
    values: Float[np.ndarray, "runs points"],
    episodes: Float[np.ndarray, "runs points"] | None,
    points: Bool[np.ndarray, " points"],
) -> Scores:
    """Return the runs that reach these points, which are the same for all of them."""
    there = np.isfinite(values[:, points]).all(axis=1)
    counted = None if episodes is None else episodes[there][:, points]
    return Scores(values[there][:, points], counted)
