"""Rollouts: they end when all episodes have ended; what is over rests and is not planned for."""

from typing import Any

import jax
import numpy as np
import pytest

from midway.agents import leap
from midway.envs.registry import make_vec
from midway.training import acting
from midway.training.evaluate import rollout


class Lengths:
    """Environments whose episodes last as many steps as they are told."""

    goal_spec, tasks, resumable, logged_info = None, ("near",), False, {}

    def state_dict(self) -> Any:
        return {}

    def load_state_dict(self, state: Any) -> None:
        pass

    def __init__(self, *lengths: int) -> None:
        self.num_envs = len(lengths)
        self.lengths = np.array(lengths)
        self.elapsed = np.zeros(self.num_envs, int)
        self.resets: list[list[bool]] = []

    def observe(self) -> Any:
        return {name: np.zeros((self.num_envs, 1)) for name in ("observation", "desired_goal")}

    def reset(self, *, options: Any) -> Any:
        self.resets.append(options["reset_mask"].tolist())
        self.elapsed[options["reset_mask"]] = 0
        return self.observe(), {}

    def step(self, actions: Any) -> Any:
        self.elapsed += 1
        over = self.elapsed >= self.lengths
        info = {"is_success": over & (self.lengths < 3)}
        return self.observe(), None, info["is_success"], over, info

    def rest(self, mask: Any) -> Any:
        return self.reset(options={"reset_mask": mask})[0]

    def ways(self) -> Any:
        return np.ones(self.num_envs)


class Still:
    """A policy that does nothing and remembers what it is told of finished episodes."""

    def __init__(self) -> None:
        self.rested: list[list[bool]] = []

    def __call__(self, observation: Any, goal: Any) -> Any:
        return np.zeros((len(observation), 1))

    def rest(self, done: Any) -> None:
        self.rested.append(done.tolist())


def test_a_rollout_ends_when_the_last_episode_has_ended() -> None:
    env, actor = Lengths(1, 4, 2), Still()
    moments = list(rollout(env, actor, env.observe()))
    assert [m.running.tolist() for m in moments] == [
        [True, True, True],
        [False, True, True],
        [False, True, False],
        [False, True, False],
    ]
    assert [np.flatnonzero(m.ended).tolist() for m in moments] == [[0], [2], [], [1]]
    assert [bool(m.success[number]) for m, number in zip(moments, (0, 2, 1, 1), strict=True)] == [
        True,
        True,
        False,
        False,
    ]


def test_environments_that_are_done_go_round_again_and_the_actor_rests_there() -> None:
    env, actor = Lengths(1, 4, 2), Still()
    list(rollout(env, actor, env.observe()))
    # The first one ends on every step, but is never told to begin again in the actor.
    assert [mask[0] for mask in env.resets] == [True] * 4
    assert actor.rested[0] == [True, False, False]
    assert actor.rested[1] == [True, False, True]
    assert actor.rested[-1] == [True, True, True]


def test_a_policy_that_knows_no_rest_is_rolled_out_too() -> None:
    env = Lengths(2, 1)
    assert len(list(rollout(env, lambda o, g: np.zeros((2, 1)), env.observe()))) == 2


def test_leap_makes_no_plan_for_episodes_that_are_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each plan is counted as it is made: those of running episodes, fewer on a short way."""
    plans = 0

    def counted(
        state: Any, observation: Any, goal: Any, segment: Any, latents: Any, key: Any
    ) -> Any:
        def count() -> None:
            nonlocal plans
            plans += 1

        jax.debug.callback(count)
        return latents

    monkeypatch.setattr(leap, "plan", counted)
    spec = make_vec("point-u").goal_spec
    config = leap.Config(hidden=(8,), num_subgoals=3, latent_size=2, vae_hidden=(8,))
    state = leap.create(config, spec, jax.random.key(0))
    steps = leap.segment_steps(config, spec)
    lengths = (1, steps, steps + 1, 2 * steps + 1, 2 * steps + 1)

    class Points(Lengths):
        def observe(self) -> Any:
            zeros = np.zeros((self.num_envs, *spec.observation_shape), np.float32)
            return {"observation": zeros, "desired_goal": zeros}

        def ways(self) -> Any:
            return np.array([1.0, 1.0, 1.0, 1.0, 0.3])

    def act(memory: Any, observation: Any, goal: Any, key: Any) -> Any:
        return acting.act(leap.AGENT, state, memory, observation, goal, key, explore=False)

    def begin(count: int, ways: Any) -> Any:
        return acting.begin(leap.AGENT, config, spec, count, ways)

    env = Points(*lengths)
    actor = acting.Actor(leap.AGENT, jax.jit(act), begin, jax.random.key(0))
    assert len(list(rollout(env, actor, env.observe()))) == max(lengths)
    jax.effects_barrier()
    # One plan at the start of each segment that an episode reaches, but for the last segment.
    assert plans == sum(min(3, -(-length // steps)) for length in lengths[:-1]) + 1 == 8
