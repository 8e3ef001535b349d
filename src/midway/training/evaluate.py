"""Evaluation: episodes of a policy, without learning."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

ActionKind: TypeAlias = Literal["mean", "sampled"]
Policy: TypeAlias = Callable[[Any, Any], Any]
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


def run_episodes(env: Any, policy: Policy, task: str, actions: ActionKind, seed: int) -> Evaluation:
    """Run one episode in each copy of the environment.

    Args:
        env: A vector environment without autoreset; one episode for each copy.
        policy: The policy, whose actions are of the kind ``actions``.
        task: Distribution of starts and goals.
        actions: ``mean`` or ``sampled``, for the record.
        seed: The same seed gives the same starts and goals.
    """
    observation, _ = env.reset(seed=seed, options={"task": task})
    episodes: list[Episode | None] = [None] * env.num_envs
    while any(episode is None for episode in episodes):
        action = np.asarray(policy(observation["observation"], observation["desired_goal"]))
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated | truncated
        for copy in np.flatnonzero(ended):
            if episodes[copy] is None:
                episodes[copy] = Episode(
                    success=bool(terminated[copy]),
                    length=int(info["elapsed_steps"][copy]),
                    final_distance=float(info["distance"][copy]),
                    final_distances=_named_distances(info, int(copy)),
                )
        if ended.any():
            # Copies that are done go round again, unrecorded, until the last one has ended.
            observation, _ = env.reset(options={"reset_mask": ended})
    return Evaluation(task, actions, tuple(e for e in episodes if e is not None))


def _named_distances(info: Mapping[str, Any], copy: int) -> dict[str, float]:
    """Return the distances of one copy that have a name: ``distance_hand`` as ``hand``."""
    return {
        name.removeprefix(PREFIX): float(values[copy])
        for name, values in info.items()
        if name.startswith(PREFIX)
    }
