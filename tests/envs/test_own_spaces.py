"""What an environment itself observes, and how it takes actions."""

import functools
from pathlib import Path
from typing import Any

import fakes
import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

import midway
from midway.agents import registry
from midway.configuration import configure
from midway.envs import own_spaces
from midway.envs.describing import describe
from midway.envs.foreign import ForeignVectorEnv
from midway.errors import ConfigurationError
from midway.runs import export
from midway.runs.policy import Policy
from midway.training.step import create_state

FORMS: Any = {
    "numbers": fakes.limited,
    "dictionary": functools.partial(fakes.Seen, "dict"),
    "image": functools.partial(fakes.Seen, "image", (48, 64, 3)),
    "without its goal": fakes.Hidden,
}


@pytest.mark.parametrize("form", FORMS)
def test_agents_see_of_one_and_of_a_batch_what_they_are_trained_on(form: str) -> None:
    foreign = describe(FORMS[form])
    vector, single = ForeignVectorEnv(foreign, 1), FORMS[form]()
    shown, _ = vector.reset(seed=4)
    single.reset(seed=0)
    plane = single.unwrapped
    plane.place = np.asarray(shown.get("achieved_state", shown["achieved_goal"])[0], np.float64)
    plane.goal = np.asarray(shown.get("desired_state", shown["desired_goal"])[0], np.float64)
    own: Any = plane.observe()
    wrapper: Any = single
    own = wrapper.observation(own) if isinstance(wrapper, gymnasium.ObservationWrapper) else own
    found = own_spaces.seen(foreign.spec, foreign, own)
    assert found.single
    np.testing.assert_array_equal(found.observation, shown["observation"])
    np.testing.assert_array_equal(found.goal, shown["desired_goal"])
    space = single.observation_space
    twice = concatenate(space, [own, own], create_empty_array(space, 2))
    both = own_spaces.seen(foreign.spec, foreign, twice)
    assert not both.single
    np.testing.assert_array_equal(both.observation, np.repeat(found.observation, 2, axis=0))
    np.testing.assert_array_equal(both.goal, np.repeat(found.goal, 2, axis=0))


def test_actions_are_in_the_environments_own_bounds_shape_and_type() -> None:
    def wide() -> Any:
        env = fakes.limited()
        low, high = np.array([[-2.0], [10.0]]), np.array([[0.0], [30.0]])
        env.unwrapped.action_space = spaces.Box(low, high, dtype=np.float64)
        env.unwrapped.step = lambda action: (env.unwrapped.observe(), 0.0, False, False, {})
        return env

    actions = np.array([[-1.0, 0.5], [3.0, -3.0]], np.float32)
    foreign = describe(wide)
    found = own_spaces.in_own_bounds(foreign.spec, foreign, actions)
    np.testing.assert_allclose(found, [[[-2.0], [25.0]], [[0.0], [10.0]]])
    assert found.dtype == np.float64
    np.testing.assert_array_equal(own_spaces.in_own_bounds(foreign.spec, None, actions), actions)


@pytest.mark.parametrize("foreign", [True, False])
def test_observations_that_are_not_the_environments_are_refused(foreign: bool) -> None:
    described = describe(fakes.limited) if foreign else None
    spec = described.spec if described else midway.make_vec("point-u").goal_spec
    goal = np.zeros(spec.goal_shape, np.float32)
    shown = {"observation": np.zeros(4, np.float32), "achieved_goal": goal, "desired_goal": goal}
    with pytest.raises(ConfigurationError, match="achieved_goal is missing"):
        own_spaces.seen(spec, described, {k: shown[k] for k in ("observation", "desired_goal")})
    with pytest.raises(ConfigurationError, match=r"desired_goal of .* has shape"):
        own_spaces.seen(spec, described, shown | {"desired_goal": np.zeros((1, 1, 9))})


def hidden() -> Any:
    """Return an environment with bounds of its own, whose observations lack the goal."""
    low, high = np.array([-2, 10], np.float32), np.array([0, 30], np.float32)
    return gymnasium.wrappers.RescaleAction(fakes.Hidden(), low, high)


def test_an_exported_policy_takes_and_gives_what_the_environment_does(tmp_path: Path) -> None:
    foreign = describe(hidden)
    config = configure(foreign, "sac", changes={"hidden": (8,), "precision": "f32"})
    agent = registry.get("sac")
    state = create_state(agent, config.hyperparameters, foreign.spec, jax.random.key(0))
    policy = Policy(agent, state, config, foreign.spec)
    act = export.write_numpy(policy, tmp_path / "policy.py")
    assert export.check(policy, act) < 1e-5
    observation, _ = hidden().reset(seed=0)
    np.testing.assert_allclose(act(observation), policy.predict(observation), rtol=1e-5)
    assert foreign.spec.observation_shape == (4,)
    assert observation["observation"].shape == (2,)
