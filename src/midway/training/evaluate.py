"""Rollouts of a policy without learning, and their evaluation."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from midway.statistics import Estimate, of_policy
from midway.training import faults
from midway.training.acting import Actor
from midway.types import AnyArray, Info, NumPyArray, Observations, VectorGoalEnv

ActionKind: TypeAlias = Literal["mean", "sampled"]
Policy: TypeAlias = Callable[[NumPyArray, NumPyArray], AnyArray]
"""``(observation, goal) -> action`` over a batch."""

PREFIX = "distance_"
"""Info of this beginning is a distance with a name."""


@dataclass(frozen=True)
class Episode:
    """One evaluated episode.

    Attributes:
        success: Whether the goal was reached.
        length: Steps taken.
        final_distance: Distance to the goal after the last step, as success measures it (m).
        final_distances: The same by name, such as ``hand`` and ``puck``, where the task names
            several.
    """

    success: bool
    length: int
    final_distance: float
    final_distances: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one task with one kind of action."""

    task: str
    actions: ActionKind
    episodes: tuple[Episode, ...]

    @property
    def success_rate(self) -> float:
        """Share of the episodes that reached their goal."""
        return float(np.mean([episode.success for episode in self.episodes]))

    @property
    def success(self) -> Estimate:
        """The same with Wilson's 95 % interval."""
        return of_policy(self.success_rate, len(self.episodes))

    @property
    def final_distance(self) -> float:
        """Mean distance to the goal at the end of an episode (m)."""
        return float(np.mean([episode.final_distance for episode in self.episodes]))

    @property
    def final_distances(self) -> dict[str, float]:
        """Mean distances at the end of an episode by name (m), where the task names several."""
        names = self.episodes[0].final_distances
        return {
            name: float(np.mean([episode.final_distances[name] for episode in self.episodes]))
            for name in names
        }

    @property
    def length(self) -> float:
        """Mean number of steps."""
        return float(np.mean([episode.length for episode in self.episodes]))


class Moment(NamedTuple):
    """One step of all environments of a rollout.

    Attributes:
        observation: Observations after the step.
        info: The environments' info.
        running: Environments whose episode was running before the step ``(K,)``.
        ended: Those of them whose episode ended with it ``(K,)``.
        success: Whether the goal was reached ``(K,)``.
    """

    observation: Observations
    info: Info
    running: NumPyArray
    ended: NumPyArray
    success: NumPyArray


def rollout(env: VectorGoalEnv, actor: Policy, observation: Observations) -> Iterator[Moment]:
    """Yield the steps of one episode in each environment, until the last one has ended.

    An environment that is done rests, and so does the actor there.

    Args:
        env: A vector environment without autoreset, just reset.
        actor: The policy; it is told of episodes that are over if it has a method ``rest``, and of
            the ways to the goals if it ``adapts``.
        observation: The observations of the reset.

    Raises:
        BrokenEnvironmentError: An environment raises, or shows what is not finite.
    """
    running = np.ones(env.num_envs, np.bool_)
    rest = getattr(actor, "rest", lambda done: None)
    if isinstance(actor, Actor) and actor.adapts:
        actor.ways = env.ways()
    while running.any():
        action = np.asarray(actor(observation["observation"], observation["desired_goal"]))
        observation, _, terminated, truncated, info = env.step(action)
        if not (sound := faults.finite(observation) | ~running).all():
            raise faults.not_finite(env, sound, info, action)
        over = terminated | truncated
        yield Moment(observation, info, running.copy(), over & running, info["is_success"])
        running &= ~over
        if over.any():
            observation = env.rest(over)
            rest(~running)


def run_episodes(
    env: VectorGoalEnv,
    policy: Policy,
    task: str,
    actions: ActionKind,
    seed: int,
    check: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Run one episode in each environment.

    Args:
        env: A vector environment without autoreset; one episode for each.
        policy: The policy, whose actions are of the kind ``actions``.
        task: Distribution of starts and goals.
        actions: ``mean`` or ``sampled``, for the record.
        seed: The same seed gives the same starts and goals.
        check: Is called after every step; what it raises ends the episodes.
    """
    observation, _ = env.reset(seed=seed, options={"task": task})
    episodes: dict[int, Episode] = {}
    for moment in rollout(env, policy, observation):
        check()
        for number in map(int, np.flatnonzero(moment.ended)):
            episodes[number] = Episode(
                success=bool(moment.success[number]),
                length=int(moment.info["elapsed_steps"][number]),
                final_distance=float(moment.info["distance"][number]),
                final_distances=_named_distances(moment.info, number),
            )
    return Evaluation(task, actions, tuple(episodes[number] for number in range(env.num_envs)))


def _named_distances(info: Info, number: int) -> dict[str, float]:
    """Return the named distances of one environment: ``distance_hand`` as ``hand``."""
    return {
        name.removeprefix(PREFIX): float(values[number])
        for name, values in info.items()
        if name.startswith(PREFIX)
    }
