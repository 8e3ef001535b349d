"""Episodes of a saved policy, recorded step by step, with the subgoals on their way."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from midway.agent import AgentState, AnyAgent, Memory, Plan, SubgoalDistribution
from midway.runs.policy import Policy
from midway.training.evaluate import ActionKind, rollout
from midway.training.progress import stages_of
from midway.types import NumPyArray, VectorGoalEnv

Found = TypeVar("Found")

Array: TypeAlias = NumPyArray

LARGEST_PICTURE = 480
"""Pixels of the longer side of what environments draw of themselves, at most."""

SUBGOALS = 20
"""Imagined subgoals that are drawn for a state and a goal."""


@dataclass(frozen=True)
class Recording:
    """One episode.

    Attributes:
        task: What start and goal were drawn from.
        observations: ``(T + 1, ...)``, from the start to the last state.
        goal: The desired goal.
        states: What success is measured on ``(T + 1, ...)``: the achieved goals, or the true states
            where these are images.
        target: What the states have to come near.
        success: Whether the goal was reached.
        final_distance: Distance to the goal at the end (m).
        plans: The plan that each of the T actions followed, where the agent plans.
        pictures: What the environment itself draws of every state, where it was asked to.
    """

    task: str
    observations: Array
    goal: Array
    states: Array
    target: Array
    success: bool
    final_distance: float
    plans: Plan | None = None
    pictures: Sequence[Array] = ()

    @property
    def length(self) -> int:
        """Steps taken."""
        return len(self.observations) - 1

    @property
    def kind(self) -> str:
        """What the subgoals are, if there are any."""
        return "imagined" if self.plans is None else "planned"


def record(
    policy: Policy,
    episodes: Mapping[str, int],
    seed: int,
    draw: bool = False,
    actions: ActionKind = "mean",
) -> list[Recording]:
    """Run episodes of a policy, all at once.

    Args:
        policy: The policy, in the environment that it was trained for.
        episodes: Number of episodes of each task.
        seed: The same seed gives the same starts and goals.
        draw: Whether the environment is to draw itself; one that is not midway's and can.
        actions: ``mean`` or ``sampled``.
    """
    tasks = np.repeat(list(episodes), list(episodes.values()))
    factory = partial(policy.config.declaration().factory, num_envs=len(tasks))
    env = factory(render_mode="rgb_array") if draw else factory()
    observation = _reset(env, tasks, seed)
    goals, targets = observation["desired_goal"].copy(), env.success_pair(observation)[1].copy()
    seen = [(observation["observation"].copy(), env.success_pair(observation)[0].copy())]
    actor, plans, reached = policy.actor(actions, seed), [], np.zeros(len(tasks), np.bool_)
    lengths, drawn = np.zeros(len(tasks), np.int64), [pictures(env)]
    told = stages_of("steps of recorded episodes", policy.spec.max_episode_steps)
    for moment in rollout(env, actor, observation):
        told()
        states = env.success_pair(moment.observation)[0]
        seen.append((moment.observation["observation"].copy(), states.copy()))
        plans.append(plan(policy, actor.memory))
        drawn.append(pictures(env))
        lengths += moment.running
        reached |= moment.ended & moment.success
    env.close()
    recordings = [
        _recording(policy, seen, plans, number, lengths, task, goals[number], targets[number])
        for number, task in enumerate(tasks.tolist())
    ]
    return [
        replace(
            recording,
            success=bool(reached[number]),
            pictures=[each[number] for each in drawn[: recording.length + 1] if each],
        )
        for number, recording in enumerate(recordings)
    ]


def pictures(env: VectorGoalEnv) -> list[Array]:
    """Return what each environment draws, no larger than needed; nothing if it was not asked to."""
    render = getattr(env, "render", None)
    drawn = render() if render is not None and getattr(env, "render_mode", None) else None
    steps = [-(-max(picture.shape[:2]) // LARGEST_PICTURE) for picture in drawn or ()]
    return [picture[::s, ::s].copy() for picture, s in zip(drawn or (), steps, strict=True)]


def _recording(
    policy: Policy,
    seen: list[tuple[Array, Array]],
    plans: list[Plan | None],
    number: int,
    lengths: Int[Array, " episodes"],
    task: str,
    goal: Array,
    target: Array,
) -> Recording:
    """Return the episode of one environment."""
    length = int(lengths[number])
    states = np.stack([state[number] for _, state in seen[: length + 1]])
    ends = states[-1:], target[None]
    measure = policy.spec.task
    followed = [each for each in plans[:length] if each is not None]
    return Recording(
        task=task,
        observations=np.stack([observation[number] for observation, _ in seen[: length + 1]]),
        goal=goal,
        states=states,
        target=target,
        success=False,
        final_distance=float(measure.distance(*ends)[0]),
        plans=_of_one(followed, number) if followed else None,
    )


def _of_one(plans: list[Plan], number: int) -> Plan:
    """Return the plans of one episode, step by step."""
    return Plan(*(np.stack([part[number] for part in parts]) for parts in zip(*plans, strict=True)))


def _reset(env: VectorGoalEnv, tasks: Array, seed: int) -> dict[str, Array]:
    """Begin one episode in each environment, each with a task of its own."""
    observation: dict[str, Array] = {}
    for task in dict.fromkeys(tasks.tolist()):
        options = {"task": task, "reset_mask": tasks == task}
        observation, _ = env.reset(seed=seed, options=options)
    return observation


def plans(agent: AnyAgent) -> bool:
    """Return whether an agent plans subgoals as it acts."""
    return agent.memory is not None and agent.memory.plan is not None


def plan(policy: Policy, memory: Memory) -> Plan | None:
    """Return the plans that a memory holds, in NumPy; None if the agent plans nothing."""
    ability = policy.agent.memory
    if ability is None or ability.plan is None:
        return None
    found = _plan(ability.plan, policy.state, memory)
    return Plan(np.asarray(found.subgoals), np.asarray(found.due))


@eqx.filter_jit
def _plan(read: Callable[[AgentState, Memory], Found], state: AgentState, memory: Memory) -> Found:
    return read(state, memory)


def draws(found: SubgoalDistribution, count: int, seed: int = 0) -> Float[np.ndarray, "B count G"]:
    """Return draws of subgoals as achieved goals.

    All pairs share their noise: along an episode subgoals move and do not flicker.

    Args:
        found: The distribution of subgoals of B pairs of state and goal.
        count: Draws for each pair.
        seed: Seed of the draws.
    """
    location, scale = found.location.achieved_goal, found.scale.achieved_goal
    noise = np.random.default_rng(seed).laplace(size=(count, location.shape[-1]))
    return np.asarray(location[:, None] + scale[:, None] * noise)


def imagined(policy: Policy, recording: Recording) -> SubgoalDistribution:
    """Return the distribution of subgoals in every state of an episode."""
    goals = np.repeat(recording.goal[None], len(recording.observations), axis=0)
    return policy.subgoals(recording.observations, goals)


def in_every_state(policy: Policy, recording: Recording) -> Float[np.ndarray, "T I G"] | None:
    """Return the subgoals in every state, imagined or planned; None if the agent has none."""
    if recording.plans is not None:
        subgoals = np.asarray(recording.plans.subgoals)
        return np.concatenate([subgoals, subgoals[-1:]])
    if policy.agent.subgoals is None:
        return None
    return draws(imagined(policy, recording), SUBGOALS)


def chain(
    policy: Policy, observation: Float[np.ndarray, " S"], goal: Float[np.ndarray, " G"], depth: int
) -> Float[np.ndarray, "N G"]:
    """Return the way from a state to a goal, imagined by halving it ``depth`` times.

    Args:
        policy: A policy that imagines.
        observation: The state.
        goal: The goal.
        depth: A chain of depth 1 is one subgoal; each further one imagines between the last.

    Returns:
        ``2 ** depth - 1`` achieved goals, from the state to the goal.
    """
    if depth == 0:
        return np.empty((0, *goal.shape))
    middle = policy.subgoals(observation[None], goal[None]).location
    reached, onwards = np.asarray(middle.achieved_goal), np.asarray(middle.observation)
    before = chain(policy, observation, reached[0], depth - 1)
    after = chain(policy, onwards[0], goal, depth - 1)
    return np.concatenate([before, reached, after])


def first_plan(
    policy: Policy, observation: Float[np.ndarray, " S"], goal: Float[np.ndarray, " G"]
) -> Float[np.ndarray, "N G"]:
    """Return the subgoals planned between a state and a goal, as an episode begins."""
    actor = policy.actor()
    actor(observation[None], goal[None])
    found = plan(policy, actor.memory)
    assert found is not None
    return np.squeeze(found.subgoals, axis=0)
