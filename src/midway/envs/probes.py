"""A few random episodes of an environment that is not midway's, to see how it behaves."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from midway.envs.group import action_bounds
from midway.envs.reading import Array, Reading, word_of
from midway.envs.sources import printing_to_stderr
from midway.errors import ConfigurationError
from midway.types import (
    NamedValues,
    OwnEnv,
)

RESETS = 5
STEPS = 200
SECONDS = 5.0
"""Probing stops after ``STEPS`` steps, or after this many seconds and ``FEWEST`` steps."""
FEWEST = 30


class Moment(NamedTuple):
    """What an environment showed after one reset or step.

    Attributes:
        entries: The arrays that its observation was read as.
        key: Where its info speaks of success, nothing where it does not.
        word: What its info says of success: 1, 0, or -1 for nothing.
        terminated: Whether it ended the episode.
        truncated: Whether it cut the episode short.
        elapsed: Steps of the episode so far.
    """

    entries: dict[str, Array]
    key: str
    word: int
    terminated: bool
    truncated: bool
    elapsed: int


@dataclass(frozen=True)
class Probes:
    """Random episodes, without those moments of which nothing else is wanted.

    Attributes:
        achieved: What success is measured on, of every moment ``(N, G)``.
        desired: The goal of every moment ``(N, G)``.
        word: What info says of success ``(N,)``: 1, 0, or -1 for nothing.
        key: Where info says so, nothing where it does not.
        observation: The observation of every moment ``(N, S)``, or images.
        goal_is_observation: Whether the achieved goal was the observation itself, always.
        seconds: Median time of one step.
    """

    achieved: Array
    desired: Array
    word: Array
    key: str
    observation: Array
    goal_is_observation: bool
    seconds: float


def random_moments(
    env: OwnEnv,
    readings: dict[str, Reading],
    action_bound: float | None,
    limit: int,
    seed: int,
    durations: list[float] | None = None,
) -> Iterator[Moment]:
    """Yield the moments of random episodes, one after the other without end.

    Args:
        env: The environment.
        readings: How its observation is read.
        action_bound: Bounds of actions that have none.
        limit: Steps of an episode.
        seed: Seed of the first episode and of the actions.
        durations: Takes the time of each step.
    """
    rng = np.random.default_rng(seed)
    low, high = action_bounds(env.action_space, action_bound)
    while True:
        with printing_to_stderr():
            observation, info = env.reset(seed=int(rng.integers(2**31)))
        yield _moment(readings, observation, info, False, False, 0)
        for elapsed in range(1, limit + 1):
            action = rng.uniform(low, high).reshape(env.action_space.shape)
            begun = time.perf_counter()
            observation, _, terminated, truncated, info = env.step(
                action.astype(env.action_space.dtype)
            )
            if durations is not None:
                durations.append(time.perf_counter() - begun)
            yield _moment(readings, observation, info, terminated, truncated, elapsed)
            if terminated or truncated:
                break


def probe(
    name: str,
    env: OwnEnv,
    readings: dict[str, Reading],
    action_bound: float | None,
    limit: int,
    seed: int = 0,
    steps: int = STEPS,
) -> Probes:
    """Return random episodes, no longer than about ``SECONDS``.

    Raises:
        ConfigurationError: Something that is observed is not finite.
    """
    durations: list[float] = []
    moments: list[Moment] = []
    for serial in range(RESETS):
        moments.append(next(random_moments(env, readings, action_bound, limit, seed + serial)))
    started = time.perf_counter()
    for moment in random_moments(env, readings, action_bound, limit, seed, durations):
        moments.append(moment)
        late = time.perf_counter() - started > SECONDS and len(durations) >= FEWEST
        if len(durations) >= steps or late:
            break
    for moment in moments:
        check_finite(name, moment)
    kind = "state" if "achieved_state" in readings else "goal"
    same = all(
        np.array_equal(m.entries["observation"], m.entries["achieved_goal"].astype("float32"))
        for m in moments
    )
    return Probes(
        achieved=np.stack([m.entries[f"achieved_{kind}"] for m in moments]),
        desired=np.stack([m.entries[f"desired_{kind}"] for m in moments]),
        word=np.array([m.word for m in moments]),
        key=next((m.key for m in moments if m.key), ""),
        observation=np.stack([m.entries["observation"] for m in moments]),
        goal_is_observation=same,
        seconds=float(np.median(durations)),
    )


def check_finite(name: str, moment: Moment) -> None:
    """Check that everything that is observed is a number.

    Raises:
        ConfigurationError: Something is not; its text names what and when.
    """
    for key, values in moment.entries.items():
        if not np.isfinite(values).all():
            place = np.flatnonzero(~np.isfinite(values))[0]
            raise ConfigurationError(
                f"{name}: {key}[{place}] is {values.ravel()[place]} after {moment.elapsed} steps "
                "of random actions: must be finite"
            )


def _moment(
    readings: dict[str, Reading],
    observation: NamedValues,
    info: NamedValues,
    terminated: object,
    truncated: object,
    elapsed: int,
) -> Moment:
    entries = {name: reading.read(observation[name]).copy() for name, reading in readings.items()}
    key, word = word_of(info)
    return Moment(entries, key, word, bool(terminated), bool(truncated), elapsed)
