"""Trajectories of others, from Minari datasets on this machine, as an environment shows them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from midway.envs.describing import Foreign
from midway.envs.group import action_bounds
from midway.envs.reading import GOAL_KEYS, STATE_KEYS, readings
from midway.envs.success import judge
from midway.errors import ConfigurationError, needing
from midway.types import NumPyArray, OwnEnv, Trajectory


def trajectories(dataset: str, foreign: Foreign) -> Iterator[Trajectory]:
    """Yield what a Minari dataset holds, cut where the goal changes and at the limit of steps.

    Args:
        dataset: Name of a dataset on this machine (``minari list local``), or its folder.
        foreign: The environment, whose observations and actions the dataset must have.

    Raises:
        ConfigurationError: There is none, or it is of another environment.
    """
    found, env = _open(dataset), judge(foreign.source)
    read = readings(foreign.spec.name, env.observation_space)
    _check(dataset, found, foreign, env)
    low, high = action_bounds(env.action_space, foreign.settings.action_bound)
    for episode in found.iterate_episodes():
        times = range(len(episode.actions) + 1)
        shown = {
            name: np.stack([reading.read(_at(episode.observations[name], time)) for time in times])
            for name, reading in read.items()
        }
        flat = np.asarray(episode.actions, np.float64).reshape(len(episode.actions), -1)
        actions = np.clip(2 * (flat - low) / (high - low) - 1, -1, 1).astype(np.float32)
        ended = bool(episode.terminations[-1])
        yield from _pieces(foreign, shown, actions, ended)


def _pieces(
    foreign: Foreign, shown: dict[str, NumPyArray], actions: NumPyArray, ended: bool
) -> Iterator[Trajectory]:
    """Yield the parts of an episode that have one goal each and are no longer than the limit."""
    spec, last = foreign.spec, len(actions)
    goal = shown["desired_goal"].reshape(last + 1, -1)
    changes = 1 + np.flatnonzero((goal[1:] != goal[:-1]).any(1))
    first = 0
    while first < last:
        later = changes[changes > first]
        end = min(last, first + spec.max_episode_steps, *(int(change) for change in later[:1]))
        part = {name: values[first : end + 1].copy() for name, values in shown.items()}
        # The observation after the last step of a goal belongs to the next one.
        for name in ("desired_goal", "desired_state"):
            if name in part:
                part[name][:] = part[name][0]
        yield Trajectory(_as_agents_see(foreign, part, ended and end == last), actions[first:end])
        first = end


def _as_agents_see(
    foreign: Foreign, shown: dict[str, NumPyArray], ended: bool
) -> dict[str, NumPyArray]:
    """Return float32 observations with the goal appended where states lack it, and ``failed``."""
    spec = foreign.spec
    kind = "goal" if spec.state_shape is None else "state"
    reached = spec.task(shown[f"achieved_{kind}"], shown[f"desired_{kind}"])[1]
    shown = {
        name: values if values.dtype == np.uint8 else values.astype(np.float32)
        for name, values in shown.items()
    }
    if shown["observation"].shape[1:] != spec.observation_shape:
        parts = shown["observation"], shown["achieved_goal"]
        shown["observation"] = np.concatenate(parts, axis=1)
    failed = np.zeros(len(reached), np.bool_)
    failed[-1] = ended and not reached[-1]
    return shown | {"failed": failed}


def _open(dataset: str) -> Any:
    with needing("data", f"--data {dataset}"):
        import minari
        from minari.dataset.minari_dataset import MinariDataset
    try:
        folder = Path(dataset)
        return MinariDataset(folder / "data") if folder.is_dir() else minari.load_dataset(dataset)
    except Exception as error:  # Minari has no error of its own for what is missing or damaged
        text = " ".join(str(error).split())
        raise ConfigurationError(f"--data {dataset}: cannot be read: {text}") from error


def _check(dataset: str, found: Any, foreign: Foreign, env: OwnEnv) -> None:
    """Compare the spaces of a dataset with those of the environment.

    Raises:
        ConfigurationError: They differ.
    """
    keys = [key for key in (*GOAL_KEYS, *STATE_KEYS) if key in env.observation_space.spaces]
    theirs = getattr(found.observation_space, "spaces", {})
    for key in keys:
        if key not in theirs or theirs[key].shape != env.observation_space[key].shape:
            shape = theirs[key].shape if key in theirs else "missing"
            raise ConfigurationError(
                f"--data {dataset}: its {key} is {shape}, but {foreign.spec.name} has "
                f"{env.observation_space[key].shape}"
            )
    if found.action_space.shape != env.action_space.shape:
        raise ConfigurationError(
            f"--data {dataset}: its actions are {found.action_space.shape}, but "
            f"{foreign.spec.name} has {env.action_space.shape}"
        )


def _at(values: Any, time: int) -> Any:
    """Return one moment of an entry, which may be a dictionary or tuple of arrays."""
    if isinstance(values, dict):
        return {name: _at(value, time) for name, value in values.items()}
    if isinstance(values, tuple):
        return tuple(_at(value, time) for value in values)
    return values[time]
