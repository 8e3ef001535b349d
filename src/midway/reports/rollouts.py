"""Episodes of a saved policy, recorded step by step."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from midway.envs import registry as environments
from midway.reports import imagination
from midway.training.policy import Policy

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Recording:
    """One episode.

    Attributes:
        task: What start and goal were drawn from.
        observations: ``(T + 1, ...)``, from the start to the last state.
        achieved: Achieved goals ``(T + 1, ...)``.
        goal: The desired goal.
        states: What success is measured on ``(T + 1, ...)``: the achieved goals, or the true states
            where these are images.
        target: What the states have to come near.
        success: Whether the goal was reached.
        final_distance: Distance to the goal at the end (m).
        plans: Subgoals that the agent followed ``(T, N, ...)``, where it plans any.
    """

    task: str
    observations: Array
    achieved: Array
    goal: Array
    states: Array
    target: Array
    success: bool
    final_distance: float
    plans: Array | None = None

    @property
    def length(self) -> int:
        """Steps taken."""
        return len(self.observations) - 1


def record(policy: Policy, episodes: Mapping[str, int], seed: int) -> list[Recording]:
    """Run episodes with mean actions, all at once.

    Args:
        policy: The policy, in the environment that it was trained for.
        episodes: Number of episodes of each task.
        seed: The same seed gives the same starts and goals.
    """
    tasks = np.repeat(list(episodes), list(episodes.values()))
    env = environments.make_vec(policy.config.env, num_envs=len(tasks))
    observation = _reset(env, tasks, seed)
    goals, targets = observation["desired_goal"].copy(), env.success_pair(observation)[1].copy()
    steps = [_copied(env, observation)]
    actor = policy.actor()
    plans: list[Array] = []
    ends: dict[int, tuple[int, bool, float]] = {}
    while len(ends) < len(tasks):
        action = actor(observation["observation"], observation["desired_goal"])
        plan = imagination.plan(policy, actor.memory)
        plans += [] if plan is None else [plan]
        observation, _, terminated, truncated, info = env.step(action)
        steps.append(_copied(env, observation))
        ended = terminated | truncated
        for copy in np.flatnonzero(ended):
            end = (len(steps), bool(terminated[copy]), float(info["distance"][copy]))
            ends.setdefault(int(copy), end)
        if ended.any():
            # Copies that are done go round again, unrecorded, until the last one has ended.
            observation, _ = env.reset(options={"reset_mask": ended})
            actor.restart(ended)
    return [
        Recording(
            task=str(task),
            **{name: np.stack([step[name][copy] for step in steps[:length]]) for name in steps[0]},
            goal=goals[copy],
            target=targets[copy],
            success=success,
            final_distance=distance,
            plans=np.stack([plan[copy] for plan in plans[: length - 1]]) if plans else None,
        )
        for copy, task in enumerate(tasks)
        for length, success, distance in [ends[copy]]
    ]


def _copied(env: Any, observation: dict[str, Array]) -> dict[str, Array]:
    """Return what a recording holds of each step, by its names there."""
    states = env.success_pair(observation)[0]
    parts = (observation["observation"], observation["achieved_goal"], states)
    names = ("observations", "achieved", "states")
    return {name: part.copy() for name, part in zip(names, parts, strict=True)}


def _reset(env: Any, tasks: Array, seed: int) -> dict[str, Array]:
    """Begin one episode in each copy, each with a task of its own."""
    observation: dict[str, Array] = {}
    for task in dict.fromkeys(tasks.tolist()):
        options = {"task": task, "reset_mask": tasks == task}
        observation, _ = env.reset(seed=seed, options=options)
    return observation
