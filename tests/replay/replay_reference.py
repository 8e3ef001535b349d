"""The replay as plain lists: what it must hold, with every content a number that names its row."""

from dataclasses import dataclass

import jax
import numpy as np

from midway.replay import buffer
from midway.types import DistanceTask, EnvSpec

VECTOR = EnvSpec(
    name="vector",
    observation_shape=(3,),
    observation_dtype="float32",
    goal_shape=(3,),
    action_dim=2,
    max_episode_steps=4,
    goal_is_observation=True,
    state_shape=None,
    task=DistanceTask(groups=((0,), (1,)), threshold=2.5),
)
PAIR = EnvSpec(
    name="pair",
    observation_shape=(5,),
    observation_dtype="float32",
    goal_shape=(2,),
    action_dim=1,
    max_episode_steps=4,
    goal_is_observation=False,
    state_shape=None,
    task=DistanceTask(groups=((0,), (1,)), threshold=2.5),
)
IMAGE = EnvSpec(
    name="image",
    observation_shape=(4, 4, 3),
    observation_dtype="uint8",
    goal_shape=(4, 4, 3),
    action_dim=2,
    max_episode_steps=4,
    goal_is_observation=True,
    state_shape=(2,),
    task=DistanceTask(groups=((0,), (1,)), threshold=2.5),
)
SIZES = [(1, 12), (3, 24)]
BATCH = 2048

# Compiled once for all tests, and quickly: these tests are about results.
begin = jax.jit(buffer.begin)
add = jax.jit(buffer.add)
withdraw = jax.jit(buffer.withdraw)
_sample = jax.jit(buffer.sample, static_argnums=(1, 2, 3, 5))


def sample(replay, spec, mix, seed, wanted=None):
    """A batch as NumPy arrays."""
    key = jax.random.key(seed)
    return jax.tree.map(np.asarray, _sample(replay, spec, mix, BATCH, key, wanted))


SPECS = {spec.name: spec for spec in (VECTOR, PAIR, IMAGE)}


def contents(shape, dtype, lanes, numbers, is_goal):
    """Values (B, *shape) that name lane and row; those of goal rows differ from those of states."""
    lanes, numbers, is_goal = np.broadcast_arrays(lanes, numbers, is_goal)
    filling = is_goal if dtype == "uint8" else 1000.0 * is_goal
    values = np.empty((len(lanes), *shape), dtype)
    values[:] = filling.reshape(-1, *[1] * len(shape))
    if dtype == "uint8":
        values[:, 0, 0] = np.stack([numbers % 256, numbers // 256, lanes], axis=1)
    else:
        values[:, :2] = np.stack([numbers, lanes], axis=1)
    return values


def names(values):
    """The (lane, number) pairs that contents name."""
    if values.dtype == np.uint8:
        low, high, lanes = values[:, 0, 0].astype(int).T
        return list(zip(lanes.tolist(), (low + 256 * high).tolist(), strict=True))
    return [(int(lane), int(number)) for number, lane in values[:, :2]]


@dataclass
class Row:
    name: tuple[int, int]
    episode: int
    is_goal: bool
    action: float | None = None


class Reference:
    """K lists of rows; the last L rows of each list are what a ring of L rows still holds.

    Where rows were withdrawn there are fewer: their places held others before.
    """

    def __init__(self, spec, num_lanes, lane_rows):
        self.spec, self.num_lanes, self.lane_rows = spec, num_lanes, lane_rows
        self.lanes = [[] for _ in range(num_lanes)]
        self.longest = [0] * num_lanes
        self.counter = 0

    def held(self, lane):
        """The rows of a lane that no later one has overwritten."""
        rows = self.lanes[lane]
        self.longest[lane] = max(self.longest[lane], len(rows))
        return rows[max(self.longest[lane] - self.lane_rows, 0) :]

    def withdraw(self, mask):
        """Remove the newest episode where masked, if its goal row is there; return the mask."""
        for lane in np.flatnonzero(mask):
            rows, held = self.lanes[lane], self.held(lane)
            newest = [row for row in held if row.episode == rows[-1].episode]
            if newest and newest[0].is_goal:
                del rows[-len(newest) :]
        return mask

    def begin(self, mask):
        """Write goal row and s_0 where masked, and return the observation of the reset."""
        for lane in np.flatnonzero(mask):
            rows = self.lanes[lane]
            if len(rows) >= 2 and rows[-2].is_goal:
                del rows[-2:]
            episode = rows[-1].episode + 1 if rows else 0
            for is_goal in (True, False):
                rows.append(Row((int(lane), self.counter), episode, is_goal))
        return self._observation(desired=self.counter)

    def add(self, mask):
        """Write a step where masked, and return its action and observation."""
        action = np.zeros((self.num_lanes, self.spec.action_dim), np.float32)
        action[:, 0] = self.counter
        for lane in np.flatnonzero(mask):
            rows = self.lanes[lane]
            if rows:
                rows[-1].action = self.counter
                rows.append(Row((int(lane), self.counter), rows[-1].episode, False))
        # The goal of a running episode is not written again: give a wrong one.
        return action, self._observation(desired=9999)

    def _observation(self, desired):
        spec = self.spec

        def stack(shape, dtype, number, is_goal):
            return contents(shape, dtype, np.arange(self.num_lanes), number, is_goal)

        goal_dtype = spec.observation_dtype if spec.goal_is_observation else "float32"
        observation = {
            "observation": stack(
                spec.observation_shape, spec.observation_dtype, self.counter, False
            ),
            "achieved_goal": stack(spec.goal_shape, goal_dtype, self.counter, False),
            "desired_goal": stack(spec.goal_shape, goal_dtype, desired, True),
        }
        if spec.state_shape is not None:
            observation["achieved_state"] = stack(spec.state_shape, "float32", self.counter, False)
            observation["desired_state"] = stack(spec.state_shape, "float32", desired, True)
        self.counter += 1
        return observation

    def episodes(self):
        """The drawable episodes: (goal row, state rows) of those whose goal row is still there."""
        found = {}
        for lane in range(self.num_lanes):
            for row in self.held(lane):
                if row.is_goal:
                    found[lane, row.episode] = (row, [])
                elif (lane, row.episode) in found:
                    found[lane, row.episode][1].append(row)
        return list(found.values())

    def states(self):
        return {row.name for _, states in self.episodes() for row in states}

    def transitions(self):
        """Name of each drawable transition's state -> (episode, index of the state in it)."""
        return {
            state.name: (goal, states, t)
            for goal, states in self.episodes()
            for t, state in enumerate(states[:-1])
        }
