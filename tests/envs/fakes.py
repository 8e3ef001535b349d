"""Small goal environments of every kind that an environment of others may be."""

import os
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

RADIUS = 0.5


class Plane(gymnasium.Env[dict[str, Any], Any]):
    """A point that is pushed about a plane; near its goal it is there.

    Args:
        reward: ``minus`` (-1, 0 at the goal), ``plus`` (0, 1 at the goal), ``dense``, ``constant``,
            ``upside`` (0, -1 at the goal), ``nan``, ``where`` (depends on the state), ``square``
            (two values, within a square), ``none`` (no compute_reward).
        word: Key of info that tells success, nothing for none.
        method: ``compute_terminated``, ``_is_success`` or nothing.
        ends: ``success``, ``cliff`` (it falls off at |x| > 1.5), ``time`` (terminated after ten
            steps), ``own`` (truncated after seven), or nothing.
        batched: Whether ``compute_reward`` takes batches.
        lies: Info tells success only where the point is also slow, or not at all when there.
        broken_at: Step at which the observation is NaN.
    """

    def __init__(
        self,
        reward: str = "minus",
        word: str = "",
        method: str = "",
        ends: str = "",
        batched: bool = True,
        lies: bool = False,
        broken_at: int = -1,
        render_mode: str | None = None,
    ) -> None:
        self.reward, self.word, self.ends, self.lies = reward, word, ends, lies
        self.batched, self.broken_at, self.render_mode = batched, broken_at, render_mode
        place = spaces.Box(-10.0, 10.0, (2,), np.float64)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-10.0, 10.0, (4,), np.float64),
                "achieved_goal": place,
                "desired_goal": place,
            }
        )
        self.action_space: gymnasium.Space[Any] = spaces.Box(-1.0, 1.0, (2,), np.float32)
        if reward != "none":
            self.compute_reward = self.rewarded
        if method:
            setattr(self, method, self.near)
        self.place, self.goal, self.speed = np.zeros(2), np.zeros(2), np.zeros(2)
        self.steps = 0

    def near(self, achieved: Any, desired: Any, info: Any = None) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) < RADIUS

    def rewarded(self, achieved: Any, desired: Any, info: Any) -> Any:
        if not self.batched and np.ndim(achieved) > 1:
            return np.float64(-1.0)
        near, away = self.near(achieved, desired), np.linalg.norm(achieved - desired, axis=-1)
        values = {
            "minus": near - 1.0,
            "plus": near * 1.0,
            "dense": -away,
            "constant": -1.0 + 0 * away,
            "upside": -1.0 * near,
            "nan": np.nan * away,
            "where": (away + self.place[0] < RADIUS) - 1.0,
            "square": (np.abs(achieved - desired).max(-1) < RADIUS) - 1.0,
        }
        return values[self.reward]

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.speed = np.zeros(2)
        self.steps = 0
        return self.observe(), self.info()

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.speed = np.asarray(action, np.float64) / 4
        self.place = self.place + self.speed
        self.steps += 1
        there = bool(self.near(self.place, self.goal))
        ends = {
            "": False,
            "own": False,
            "success": there,
            "cliff": abs(self.place[0]) > 1.5,
            "time": self.steps == 10,
        }
        truncated = self.ends == "own" and self.steps == 7
        return self.observe(), 0.0, bool(ends[self.ends]), truncated, self.info()

    def info(self) -> dict[str, Any]:
        there = bool(self.near(self.place, self.goal))
        if self.lies:
            there = there and self.steps > 0 and bool(np.abs(self.speed).max() < 0.05)
        return {self.word: there} if self.word else {}

    def observe(self) -> dict[str, Any]:
        values = np.concatenate([self.place, self.speed])
        if self.steps == self.broken_at:
            values[0] = np.nan
        return {
            "observation": values,
            "achieved_goal": self.place.copy(),
            "desired_goal": self.goal.copy(),
        }

    def render(self) -> Any:
        return np.full((8, 8, 3), self.steps, np.uint8)


RAISES, HANGS, EXITS = (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)
"""Actions that `Obedient` obeys."""


class Obedient(Plane):
    """The plane, which breaks where its action says so."""

    def step(self, action: Any) -> Any:
        match tuple(np.asarray(action).tolist()):
            case (1.0, -1.0):
                raise ValueError("the\nsimulator is tired")
            case (-1.0, 1.0):
                time.sleep(1_000)
            case (1.0, 1.0):
                os._exit(3)
        return super().step(action)


def obedient() -> Any:
    return gymnasium.wrappers.TimeLimit(Obedient(), 20)


class Seen(gymnasium.ObservationWrapper[Any, Any, Any]):
    """The plane as it is observed in another form."""

    def __init__(self, form: str = "dict", shape: tuple[int, ...] = (84, 84, 3)) -> None:
        super().__init__(gymnasium.wrappers.TimeLimit(Plane(), 20))
        self.form, self.shape = form, shape
        old: Any = self.env.observation_space
        new: Any = {
            "dict": spaces.Dict({"at": spaces.Box(-9, 9, (2, 1)), "on": spaces.Discrete(3)}),
            "image": spaces.Box(0, 255, shape, np.uint8),
            "same": old["achieved_goal"],
        }[form]
        shown = {**old.spaces, "observation": new}
        if form == "image":
            states = {"achieved_state": old["achieved_goal"], "desired_state": old["desired_goal"]}
            shown |= {"achieved_goal": new, "desired_goal": new} | states
        self.observation_space = spaces.Dict(shown)

    def observation(self, observation: Any) -> Any:
        place = observation["achieved_goal"]
        new: Any = {
            "dict": {"at": place.astype(np.float32)[:, None], "on": 1},
            "image": np.full(self.shape, 100, np.uint8),
            "same": place,
        }[self.form]
        if self.form == "image":
            goals = {"achieved_goal": new, "desired_goal": new}
            states = {"achieved_state": place, "desired_state": observation["desired_goal"]}
            return {"observation": new} | goals | states
        return {**observation, "observation": new}


class Hidden(gymnasium.ObservationWrapper[Any, Any, Any]):
    """The plane where only the speed is observed, and the place as the achieved goal."""

    def __init__(self) -> None:
        super().__init__(gymnasium.wrappers.TimeLimit(Plane(), 20))
        old: Any = self.env.observation_space
        self.observation_space = spaces.Dict({**old.spaces, "observation": old["achieved_goal"]})

    def observation(self, observation: Any) -> Any:
        return {**observation, "observation": observation["observation"][2:]}


class Told(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The plane where the goal is a whole observation, told in the info of a reset."""

    def __init__(self) -> None:
        super().__init__(gymnasium.wrappers.TimeLimit(Plane(reward="none"), 20))
        spaces_of: Any = self.env.observation_space
        self.observation_space = spaces_of["observation"]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        shown, info = self.env.reset(seed=seed, options=options)
        goal = np.concatenate([shown["desired_goal"], np.zeros(2)])
        return shown["observation"], info | {"goal": goal}

    def step(self, action: Any) -> Any:
        shown, *others = self.env.step(action)
        return shown["observation"], *others


def limited(**options: Any) -> gymnasium.Env[Any, Any]:
    """The plane with twenty steps in an episode."""
    return gymnasium.wrappers.TimeLimit(Plane(**options), 20)


def broken() -> Any:
    """Fail as gymnasium-robotics does: without a word."""
    raise AssertionError


def within(achieved: Any, desired: Any) -> Any:
    """Whether the goal is near, of NumPy and JAX arrays."""
    return ((achieved - desired) ** 2).sum(-1) < RADIUS**2


def within_numpy(achieved: Any, desired: Any) -> Any:
    """Whether the goal is near, of NumPy arrays."""
    return np.asarray(np.linalg.norm(np.asarray(achieved - desired), axis=-1)) < RADIUS


def within_pair(achieved: Any, desired: Any) -> bool:
    """Whether one goal is near."""
    return float(np.hypot(*(achieved - desired))) < RADIUS


def never(achieved: Any, desired: Any) -> bool:
    """Whether a goal is reached that cannot be."""
    return False
