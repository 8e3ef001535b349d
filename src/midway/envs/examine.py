"""What midway sees of an environment, in about ten lines."""

import itertools
import time
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from midway.envs import registry
from midway.envs.deciding import REMEDY
from midway.envs.describing import Foreign, Settings, describe
from midway.envs.registry import Declaration
from midway.envs.success import judge
from midway.envs.vector import GoalVectorEnv
from midway.errors import ConfigurationError
from midway.types import EnvSpec, NamedValues, NumPyArray, Observations, OwnEnv

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
        lowest: Smallest value of each entry of an observation.
        highest: Largest value.
    """

    reached: list[int]
    failed: list[int]
    late: list[int]
    lowest: NumPyArray
    highest: NumPyArray
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
        env: A name, a declaration, a callable that makes environments, or what ``gymnasium.make``
            returned.
        settings: What the user says of one that is not midway's.
        num_envs: Environments stepped together to measure.
        seconds: How long random actions are taken, at most.
        source: ``kwargs`` and ``imports``, as of `describe`.
    """
    own = isinstance(env, Declaration) or (isinstance(env, str) and env in registry.ENVIRONMENTS)
    try:
        declared = registry.entry(env if own else describe(env, settings, **source))
        made = declared.factory(num_envs)
    except ConfigurationError as error:
        return [("wrong", str(error), False)]
    spec, foreign = made.goal_spec, declared.foreign
    findings = [
        ("environment", declared.name, True),
        ("observation", _observation(spec, foreign), True),
        ("goal", _goal(spec, foreign), True),
        ("actions", _actions(spec, foreign), True),
        ("success", f"a goal is reached {spec.task.description}", True),
    ]
    try:
        tally = _random_episodes(made, seconds)
    except (ConfigurationError, RuntimeError) as error:
        return [*findings, ("wrong", " ".join(str(error).split()), False)]
    finally:
        made.close()
    return [*findings, *_judged(spec, tally, num_envs)]


def _observation(spec: EnvSpec, foreign: Foreign | None) -> str:
    shown = f"{spec.observation_shape} {spec.observation_dtype}"
    return f"{shown}{_read_from(foreign, 'observation')}"


def _goal(spec: EnvSpec, foreign: Foreign | None) -> str:
    return f"{spec.goal_shape}{_read_from(foreign, 'desired_goal')}: {_role(spec)}"


def _role(spec: EnvSpec) -> str:
    """Return what the achieved goal is in the observation."""
    if spec.goal_is_observation:
        return "the observation itself"
    return f"entries {list(spec.goal_coordinates)} of the observation"


def _read_from(foreign: Foreign | None, key: str) -> str:
    """Return which space is read; nothing for an environment of midway's own."""
    if foreign is None:
        return ""
    space = judge(foreign.source).observation_space[key]
    if space.shape is None:
        return f", read from {type(space).__name__}"
    return f", read from {type(space).__name__} {space.shape} {space.dtype}"


def _actions(spec: EnvSpec, foreign: Foreign | None) -> str:
    if foreign is None:
        return f"{spec.action_dim}, from -1 to 1"
    space = judge(foreign.source).action_space
    if not space.is_bounded():
        return f"{spec.action_dim}, without bounds: {foreign.settings.action_bound} is given"
    return f"{spec.action_dim}, from {space.low.min():.4g} to {space.high.max():.4g}"


def _random_episodes(env: GoalVectorEnv, seconds: float) -> Tally:
    """Return how episodes of random actions end."""
    rng = np.random.default_rng(0)
    shown, info = env.reset(seed=0)
    tally = Tally([], [], [], shown["observation"].min(0), shown["observation"].max(0))
    _note_begun(tally, info, np.ones(env.num_envs, np.bool_))
    started = time.perf_counter()
    for _ in itertools.count():
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        begun = time.perf_counter()
        shown, _, terminated, truncated, info = env.step(action)
        tally.seconds += time.perf_counter() - begun
        tally.steps += env.num_envs
        _note_step(tally, shown, info, terminated | truncated)
        if tally.ended >= EPISODES or time.perf_counter() - started > seconds:
            break
        if (terminated | truncated).any():
            mask = terminated | truncated
            _, info = env.reset(options={"reset_mask": mask})
            _note_begun(tally, info, mask)
    return tally


def _note_begun(tally: Tally, info: NamedValues, mask: NumPyArray) -> None:
    tally.begun += int(mask.sum())
    tally.at_once += int((info["is_success"] & mask).sum())


def _note_step(tally: Tally, shown: Observations, info: NamedValues, ended: NumPyArray) -> None:
    tally.nearest = min(tally.nearest, float(info["distance"].min()))
    tally.lowest = np.minimum(tally.lowest, shown["observation"].min(0))
    tally.highest = np.maximum(tally.highest, shown["observation"].max(0))
    failures = info.get("failed", np.zeros_like(ended))  # midway's own never fail
    for copy in np.flatnonzero(ended):
        reached, failed = info["is_success"][copy], failures[copy]
        kind = tally.reached if reached else tally.failed if failed else tally.late
        kind.append(int(info["elapsed_steps"][copy]))


def _judged(spec: EnvSpec, tally: Tally, num_envs: int) -> list[Finding]:
    """Return findings about random actions, and what is wrong with them."""
    limit = spec.max_episode_steps
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
        ("ranges", _ranges(tally), True),
        ("speed", f"{speed:,.0f} steps per second of {num_envs} environments", True),
    ]
    return findings + [("wrong", text, False) for text in _faults(spec, tally, rate, at_once)]


def _ranges(tally: Tally) -> str:
    """Return how far the entries of observations go, and how unequal they are."""
    low, high = tally.lowest.astype(float), tally.highest.astype(float)
    widths = (high - low)[high > low]
    text = f"observations lie between {low.min():.4g} and {high.max():.4g}"
    if not widths.size:
        return f"{text}, and never change"
    return f"{text}; entries vary by {widths.min():.3g} to {widths.max():.3g}"


def _range(lengths: list[int]) -> str:
    low, high = min(lengths), max(lengths)
    return f"after {low} steps" if low == high else f"after {low} to {high} steps"


def _faults(spec: EnvSpec, tally: Tally, rate: float, at_once: float) -> list[str]:
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
    if "which is slow" in spec.task.description:
        faults.append("success is asked pair by pair: --success-distance, or batches, are faster")
    return faults
