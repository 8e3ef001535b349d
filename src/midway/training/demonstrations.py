"""Trajectories of others in the replay, before the first step of one's own."""

import itertools
from collections.abc import Iterable

import numpy as np

from midway.errors import ConfigurationError
from midway.replay.storage import ReplayState
from midway.training import step
from midway.types import EnvSpec, NumPyArray, Trajectory


def fill(
    replay: ReplayState, spec: EnvSpec, num_lanes: int, trajectories: Iterable[Trajectory]
) -> tuple[ReplayState, int]:
    """Return the replay with these trajectories, lane after lane, and the number of their steps.

    Where there are more than it holds, the last ones stay.

    Raises:
        ConfigurationError: There are none.
    """
    count, waiting = 0, iter(trajectories)
    while together := list(itertools.islice(waiting, num_lanes)):
        lengths = np.array([len(each.actions) for each in together] + [0] * num_lanes)[:num_lanes]
        replay = step.begin(replay, _moment(together, 0, num_lanes), lengths > 0)
        for time in range(int(lengths.max())):
            actions = np.zeros((num_lanes, spec.action_dim), np.float32)
            for lane, each in enumerate(together):
                actions[lane] = each.actions[min(time, len(each.actions) - 1)]
            shown = _moment(together, time + 1, num_lanes)
            replay = step.add(replay, actions, shown, time < lengths)
        count += int(lengths.sum())
    if count == 0:
        raise ConfigurationError("the dataset holds no step")
    return replay, count


def _moment(together: list[Trajectory], time: int, num_lanes: int) -> dict[str, NumPyArray]:
    """Return what each lane shows at a time, or its last moment; lanes without any show zeros."""
    shown = {}
    for name, values in together[0].observations.items():
        shown[name] = np.zeros((num_lanes, *values.shape[1:]), values.dtype)
        for lane, each in enumerate(together):
            shown[name][lane] = each.observations[name][min(time, len(each.actions))]
    return shown
