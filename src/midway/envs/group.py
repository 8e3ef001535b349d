"""Several environments that are not midway's, stepped one after the other by one process."""

import contextlib
import json
import os
import signal
from collections.abc import Iterator

import gymnasium
import numpy as np
from gymnasium import spaces

from midway.envs.reading import AnySpace, Array, Reading, readings, word_of
from midway.envs.sources import Source, printing_to_stderr
from midway.types import (
    NamedValues,
    Options,
    OwnEnv,
)

FLAGS = ("terminated", "truncated", "word", "broken")
"""What each environment said of its last step; ``word``: of success, -1 where it said nothing;
``broken``: it raised, and another takes its place when it is reset."""


class Group(gymnasium.Env[dict[str, Array], Array]):
    """Some of the environments of a vector environment, as if they were one.

    One process steps a group. Everything travels in the observation, and so through the memory
    that ``AsyncVectorEnv`` shares. ``reset`` takes ``options``: ``mask`` and ``seeds`` of every
    environment of all groups; the environments themselves are made when they are first reset. What
    they raise is told in info: ``raised``, a JSON object of texts by their numbers.

    Args:
        source: What makes the environments.
        spaces_of: Observation and action space of one of them.
        first: Number of this group's first environment.
        size: Number of places of the group.
        total: Number of environments of all groups.
        max_episode_steps: Limit in place of the registered one.
        action_bound: Bounds of actions that have none.
        render_mode: Gymnasium's.
        busy: File of a byte for each environment of all groups, which is 1 while it is asked.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        source: Source,
        spaces_of: tuple[AnySpace, spaces.Box],
        first: int,
        size: int,
        total: int,
        max_episode_steps: int | None = None,
        action_bound: float | None = None,
        render_mode: str | None = None,
        busy: str | None = None,
    ) -> None:
        self.source, self.render_mode = source, render_mode
        self.places = range(first, min(first + size, total))
        self.limit = max_episode_steps
        self.readings: dict[str, Reading] = readings(source.reference, spaces_of[0])
        self.low, self.high = action_bounds(spaces_of[1], action_bound)
        boxes: dict[str, AnySpace] = {
            name: reading.box(size) for name, reading in self.readings.items()
        }
        flags = {name: spaces.Box(-1, 1, (size,), np.int8) for name in FLAGS}
        shown = spaces.Dict(boxes | flags)
        self.observation_space: AnySpace = shown
        self.action_space = spaces.Box(-1, 1, (size, self.low.size), np.float32)
        self.envs: list[OwnEnv] = [None for _ in self.places]
        self.busy = np.zeros(total, np.uint8)
        if busy is not None:
            self.busy = np.memmap(busy, np.uint8, "r+", shape=(total,))
        self.raised: dict[int, str] = {}
        self.held: dict[str, Array] = {
            name: np.zeros(box.shape or (), box.dtype) for name, box in shown.items()
        }

    def reset(
        self, *, seed: int | None = None, options: NamedValues | None = None
    ) -> tuple[dict[str, Array], NamedValues]:
        """Start new episodes in the environments of the mask."""
        mask, seeds = (options or {})["mask"], (options or {})["seeds"]
        for place, index in enumerate(self.places):
            if mask[index]:
                if self.envs[place] is None:
                    self.envs[place] = self.source.make(self.limit, self.render_mode)
                with self._noting(place), printing_to_stderr():
                    observation, info = self.envs[place].reset(seed=int(seeds[index]))
                    self._hold(place, observation, info, False, False)
        return self.held, self._take_raised()

    def step(self, actions: Array) -> tuple[dict[str, Array], float, bool, bool, NamedValues]:
        """Move every environment by one step, by actions in [-1, 1]; NaN: it rests."""
        wanted = scaled(actions, self.low, self.high)
        for place, env in enumerate(self.envs):
            if env is None or np.isnan(wanted[place]).any():
                self._flag(place, False, False, -1, False)
                continue
            action = wanted[place].reshape(env.action_space.shape).astype(env.action_space.dtype)
            with self._noting(place):
                observation, _, terminated, truncated, info = env.step(action)
                self._hold(place, observation, info, terminated, truncated)
        return self.held, 0.0, False, False, self._take_raised()

    def render(self) -> list[object]:  # type: ignore[override]
        """Return a picture of each environment."""
        return [env.render() for env in filter(None, self.envs)]

    def close(self) -> None:
        """Close every environment."""
        for env in filter(None, self.envs):
            env.close()
        self.envs = [None for _ in self.places]

    def work_alone(self) -> None:
        """Leave signals to the process that trains, which ends this one when it is done."""
        for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            signal.signal(name, signal.SIG_IGN)
        os.dup2(2, 1)

    @contextlib.contextmanager
    def _noting(self, place: int) -> Iterator[None]:
        """Note that an environment is asked, and what it raises; it is not asked again then."""
        copy = self.places[place]
        self.busy[copy] = True
        try:
            yield
        except Exception as error:  # whatever the code of others raises
            self.raised[copy] = f"{type(error).__name__}: {error}"
            broken, self.envs[place] = self.envs[place], None
            with contextlib.suppress(Exception):
                broken.close()
            self._flag(place, False, False, -1, True)
        finally:
            self.busy[copy] = False

    def _take_raised(self) -> NamedValues:
        raised, self.raised = self.raised, {}
        return {"raised": json.dumps(raised)} if raised else {}

    def _hold(self, place: int, observation: Options, info: Options, *ends: bool) -> None:
        for name, reading in self.readings.items():
            self.held[name][place] = reading.read(observation[name])
        self._flag(place, *ends, word_of(info)[1], False)

    def _flag(self, place: int, *flags: int) -> None:
        for name, value in zip(FLAGS, flags, strict=True):
            self.held[name][place] = value


def action_bounds(space: spaces.Box, bound: float | None) -> tuple[Array, Array]:
    """Return the flat bounds of actions; those that are not finite are at ``bound``."""
    low, high = (np.asarray(side, np.float64).ravel() for side in (space.low, space.high))
    if bound is None:
        return low, high
    return np.where(np.isfinite(low), low, -bound), np.where(np.isfinite(high), high, bound)


def scaled(actions: Array, low: Array, high: Array) -> Array:
    """Return actions in [-1, 1] ``(..., A)`` between these bounds; beyond is the nearest bound."""
    return np.asarray(low + (np.clip(actions, -1, 1) + 1) / 2 * (high - low))
