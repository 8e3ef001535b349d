"""What midway sees of an environment that is not its own, in about ten lines."""

import itertools
import time
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from midway.envs.deciding import REMEDY
from midway.envs.describing import Foreign, Settings, describe
from midway.envs.foreign import ForeignVectorEnv
from midway.envs.success import judge
from midway.errors import ConfigurationError
from midway.types import (
    EnvSpec,
    NamedValues,
    NumPyArray,
    OwnEnv,
)

Finding: TypeAlias = tuple[str, str, bool]
"""What was looked at, what was found, and whether it is well."""

EPISODES = 10
SECONDS = 15.0
"""Random actions are taken for at most this long, but for one whole step at least."""


@dataclass
class Tally:
    """How episodes of random actions ended.

    Attributes:
        reached: Length of the episodes that reached their goal.
        failed: Length of those that the environment ended without.
        late: Length of those that were cut short.
        steps: Steps taken.
        seconds: Time that they took.
        nearest: Smallest distance to a goal.
        at_once: Goals that were reached before the first action.
        begun: Episodes that began.
    """

    reached: list[int]
    failed: list[int]
    late: list[int]
    steps: int = 0
    seconds: float = 0.0
    nearest: float = np.inf
    at_once: int = 0
    begun: int = 0

    @property
    def ended(self) -> int:
        """Number of episodes that ended."""
        return len(self.reached) + len(self.failed) + len(self.late)


def examine(
    env: OwnEnv,
    settings: Settings | None = None,
    num_envs: int = 16,
    seconds: float = SECONDS,
    **source: Any,
) -> list[Finding]:
    """Return what midway sees of an environment, one finding for a line.

    Args:
        env: A name, a callable that makes environments, or what ``gymnasium.make`` returned.
        settings: What the user says of it.
        num_envs: Environments stepped together to measure.
        seconds: How long random actions are taken, at most.
        source: ``kwargs`` and ``imports``, as of `describe`.
    """
    try:
        foreign = describe(env, settings, **source)
    except ConfigurationError as error:
        return [("wrong", str(error), False)]
    spaces = judge(foreign.source).observation_space
    findings = [
        ("environment", foreign.spec.name, True),
        ("observation", _observation(foreign, spaces), True),
        ("goal", _goal(foreign, spaces), True),
        ("actions", _actions(foreign), True),
        ("success", f"a goal is reached {foreign.rule.description}", True),
    ]
    try:
        tally = _random_episodes(foreign, num_envs, seconds)
    except (ConfigurationError, RuntimeError) as error:
        return [*findings, ("wrong", " ".join(str(error).split()), False)]
    return [*findings, *_judged(foreign, tally, num_envs)]


def _observation(foreign: Foreign, spaces: Any) -> str:
    spec = foreign.spec
    shown = f"{spec.observation_shape} {spec.observation_dtype}"
    return f"{shown}, read from {_space(spaces['observation'])}"


def _goal(foreign: Foreign, spaces: Any) -> str:
    spec = foreign.spec
    return f"{spec.goal_shape}, read from {_space(spaces['desired_goal'])}: {_role(spec)}"


def _role(spec: EnvSpec) -> str:
    """Return what the achieved goal is in the observation."""
    if spec.goal_is_observation:
        return "the observation itself"
    return f"entries {list(spec.goal_coordinates)} of the observation"


def _space(space: Any) -> str:
    if space.shape is None:
        return type(space).__name__
    return f"{type(space).__name__} {space.shape} {space.dtype}"


def _actions(foreign: Foreign) -> str:
    space = judge(foreign.source).action_space
    low, high = float(space.low.min()), float(space.high.max())
    if not space.is_bounded():
        bound = foreign.settings.action_bound
        return f"{foreign.spec.action_dim}, without bounds: {bound} is given"
    return f"{foreign.spec.action_dim}, from {low:.4g} to {high:.4g}"


def _random_episodes(foreign: Foreign, num_envs: int, seconds: float) -> Tally:
    """Return how episodes of random actions end."""
    tally = Tally([], [], [])
    env = ForeignVectorEnv(foreign, num_envs)
    rng = np.random.default_rng(0)
    try:
        _, info = env.reset(seed=0)
        _note_begun(tally, info, np.ones(num_envs, np.bool_))
        started = time.perf_counter()
        for _ in itertools.count():
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            begun = time.perf_counter()
            _, _, terminated, truncated, info = env.step(action)
            tally.seconds += time.perf_counter() - begun
            tally.steps += num_envs
            tally.nearest = min(tally.nearest, float(info["distance"].min()))
            _note_ended(tally, info, terminated | truncated)
            if tally.ended >= EPISODES or time.perf_counter() - started > seconds:
                return tally
            if (terminated | truncated).any():
                mask = terminated | truncated
                _, info = env.reset(options={"reset_mask": mask})
                _note_begun(tally, info, mask)
    finally:
        env.close()
    return tally


def _note_begun(tally: Tally, info: NamedValues, mask: NumPyArray) -> None:
    tally.begun += int(mask.sum())
    tally.at_once += int((info["is_success"] & mask).sum())


def _note_ended(tally: Tally, info: NamedValues, ended: NumPyArray) -> None:
    for copy in np.flatnonzero(ended):
        reached, failed = info["is_success"][copy], info["failed"][copy]
        kind = tally.reached if reached else tally.failed if failed else tally.late
        kind.append(int(info["elapsed_steps"][copy]))


def _judged(foreign: Foreign, tally: Tally, num_envs: int) -> list[Finding]:
    """Return findings about random actions, and what is wrong with them."""
    limit = foreign.spec.max_episode_steps
    kinds = (("success", tally.reached), ("failure", tally.failed), ("the limit", tally.late))
    ends = [f"{len(lengths)} by {name} ({_range(lengths)})" for name, lengths in kinds if lengths]
    rate = len(tally.reached) / tally.ended if tally.ended else 0.0
    speed = tally.steps / tally.seconds
    at_once = tally.at_once / tally.begun
    findings = [
        ("episodes", f"of at most {limit} steps", True),
        (
            "random actions",
            f"reach {rate:.0%} of {tally.ended} goals, and come within {tally.nearest:.3g}",
            True,
        ),
        ("endings", ", ".join(ends) or "none yet", True),
        ("speed", f"{speed:,.0f} steps per second of {num_envs} environments", True),
    ]
    return findings + [("wrong", text, False) for text in _faults(foreign, tally, rate, at_once)]


def _range(lengths: list[int]) -> str:
    low, high = min(lengths), max(lengths)
    return f"after {low} steps" if low == high else f"after {low} to {high} steps"


def _faults(foreign: Foreign, tally: Tally, rate: float, at_once: float) -> list[str]:
    faults = []
    if at_once > 0.5:
        faults.append(f"{at_once:.0%} of the goals are reached before the first action: {REMEDY}")
    elif rate == 1 and tally.ended >= EPISODES and max(tally.reached) < 5:
        faults.append("random actions reach every goal within five steps: is the rule too wide?")
    if len(tally.failed) >= 5 and len(set(tally.failed)) == 1:
        faults.append(
            f"every failure comes after {tally.failed[0]} steps: if that is its limit of time, "
            f"give --max-episode-steps {tally.failed[0]}"
        )
    if "which is slow" in foreign.rule.description:
        faults.append("success is asked pair by pair: --success-distance, or batches, are faster")
    return faults
