"""Success in environments that are not midway's: decided on evidence, or refused."""

import functools
import json
from typing import Any

import fakes
import jax
import numpy as np
import pytest

from midway.envs import deciding, success
from midway.envs.describing import Foreign, Settings, describe
from midway.envs.foreign import ForeignVectorEnv
from midway.envs.success import AskedRule, DistanceRule, FunctionRule
from midway.errors import ConfigurationError
from midway.types import GoalTask

WAYS: dict[str, tuple[dict[str, Any], Settings, type[Any]]] = {
    "minus": ({"reward": "minus"}, Settings(), DistanceRule),
    "plus": ({"reward": "plus"}, Settings(), DistanceRule),
    "plus and info": ({"reward": "plus", "word": "success"}, Settings(), DistanceRule),
    "not batched": ({"reward": "minus", "batched": False}, Settings(), DistanceRule),
    "compute_terminated": (
        {"reward": "dense", "method": "compute_terminated"},
        Settings(),
        DistanceRule,
    ),
    "_is_success": (
        {"reward": "dense", "method": "_is_success", "word": "is_success"},
        Settings(),
        DistanceRule,
    ),
    "info alone": ({"reward": "dense", "word": "is_success"}, Settings(), DistanceRule),
    "info, no reward": ({"reward": "none", "word": "success"}, Settings(), DistanceRule),
    "distance": ({"reward": "none"}, Settings(success_distance=0.5), DistanceRule),
    "function": ({"reward": "none"}, Settings(success_function="fakes:within"), FunctionRule),
    "NumPy function": (
        {"reward": "none"},
        Settings(success_function="fakes:within_numpy"),
        FunctionRule,
    ),
    "function of a pair": (
        {"reward": "none"},
        Settings(success_function=fakes.within_pair),
        FunctionRule,
    ),
}


def plane(settings: Settings | None = None, **options: Any) -> Foreign:
    return describe(fakes.limited, settings, options)


def episodes(foreign: Foreign) -> list[Any]:
    """Return success and ends of a hundred steps of four environments."""
    env = ForeignVectorEnv(foreign, 4)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(100):
        _, _, terminated, truncated, info = env.step(rng.uniform(-1, 1, (4, 2)).astype("float32"))
        seen.append([info["is_success"], terminated, truncated])
        ended = terminated | truncated
        if ended.any():
            env.reset(options={"reset_mask": ended})
    env.close()
    return np.array(seen).tolist()


@functools.cache
def expected() -> list[Any]:
    """Return what an independent loop over the environments themselves says."""
    from gymnasium.utils.seeding import np_random

    envs = [fakes.Plane() for _ in range(4)]
    seeds = [np_random(3 + copy)[0] for copy in range(4)]
    for env, rng in zip(envs, seeds, strict=True):
        env.reset(seed=int(rng.integers(2**31)))
    actions = np.random.default_rng(0)
    seen = []
    for _ in range(100):
        row = []
        for env, rng, action in zip(
            envs, seeds, actions.uniform(-1, 1, (4, 2)).astype("float32"), strict=True
        ):
            env.step(action)
            reached, late = bool(env.near(env.place, env.goal)), env.steps == 20
            row.append([reached, reached, late])
            if reached or late:
                env.reset(seed=int(rng.integers(2**31)))
        seen.append(np.array(row).T)
    return np.array(seen).tolist()


@pytest.mark.parametrize("way", WAYS)
def test_every_way_says_what_the_environment_itself_says(way: str) -> None:
    options, settings, kind = WAYS[way]
    foreign = plane(settings, **options)
    assert isinstance(foreign.rule, kind)
    assert isinstance(foreign.rule, GoalTask)
    assert "\n" not in foreign.description
    assert episodes(foreign) == expected()
    assert np.any(expected())


@pytest.mark.parametrize("way", WAYS)
def test_every_way_is_the_same_inside_a_compiled_step(way: str) -> None:
    options, settings, _ = WAYS[way]
    task = plane(settings, **options).rule
    rng = np.random.default_rng(0)
    achieved = rng.uniform(-1, 1, (256, 2)).astype(np.float32)
    desired = rng.uniform(-1, 1, (256, 2)).astype(np.float32)
    near = np.linalg.norm(achieved - desired, axis=1) < 0.5
    for reward, terminated in (task(achieved, desired), jax.jit(task)(achieved, desired)):
        np.testing.assert_array_equal(np.asarray(terminated), near)
        assert np.asarray(reward).dtype == np.float32
        assert (np.asarray(reward) == -1).all()
    stacked = jax.jit(jax.vmap(task))(achieved.reshape(4, 64, 2), desired.reshape(4, 64, 2))[1]
    np.testing.assert_array_equal(np.asarray(stacked).ravel(), near)
    np.testing.assert_allclose(
        task.distance(achieved, desired), np.linalg.norm(achieved - desired, axis=1), rtol=1e-6
    )


@pytest.mark.parametrize("way", WAYS)
def test_a_rule_is_a_value_that_can_be_stored(way: str) -> None:
    options, settings, _ = WAYS[way]
    rule = plane(settings, **options).rule
    again = success.from_json(json.loads(json.dumps(rule.to_json())))
    assert again == rule
    assert hash(again) == hash(rule)


def test_functions_are_asked_as_fast_as_they_can_be() -> None:
    for function, how in (("within", "compiled"), ("within_numpy", "batched")):
        rule = plane(Settings(success_function=f"fakes:{function}"), reward="none").rule
        assert isinstance(rule, FunctionRule)
        assert rule.how == how
    rule = plane(Settings(success_function=lambda a, d: fakes.within(a, d)), reward="none").rule
    with pytest.raises(ConfigurationError, match="cannot be stored"):
        rule.to_json()


@pytest.mark.parametrize("batched", [True, False])
def test_what_is_no_distance_is_asked_of_the_environment(batched: bool) -> None:
    rule = plane(reward="square", batched=batched).rule
    assert isinstance(rule, AskedRule)
    assert rule.batched == batched
    assert ("pair by pair" in rule.description) != batched
    assert success.from_json(json.loads(json.dumps(rule.to_json()))) == rule
    rng = np.random.default_rng(1)
    achieved = rng.uniform(-1, 1, (64, 2)).astype(np.float32)
    inside = np.abs(achieved).max(1) < 0.5
    np.testing.assert_array_equal(rule(achieved, 0 * achieved)[1], inside)
    np.testing.assert_array_equal(np.asarray(jax.jit(rule)(achieved, 0 * achieved)[1]), inside)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"reward": "dense"}, "compute_reward is dense .*info says nothing"),
        ({"reward": "constant"}, "compute_reward is always -1"),
        ({"reward": "upside"}, "has two values, -1 and 0, but is not always 0 at the goal"),
        ({"reward": "nan"}, "compute_reward is NaN"),
        ({"reward": "where"}, "depends on more than the two goals"),
        ({"reward": "none"}, "info says nothing of success"),
        ({"reward": "square", "word": "success", "lies": True}, "where info.'success'. is False"),
    ],
)
def test_what_does_not_say_when_a_goal_is_reached_is_refused(
    options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigurationError, match=reason) as raised:
        plane(**options)
    text = str(raised.value)
    assert "\n" not in text
    assert "--success-distance D or --success-function MODULE:FUNCTION" in text


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (Settings(success_distance=-1.0), "must be positive"),
        (Settings(success_distance=0.1, success_function="fakes:within"), "not both"),
        (Settings(success_function="fakes:nothing"), "has no such function"),
        (Settings(success_function="fakes"), "must be module:function"),
        (Settings(success_function="nowhere:within"), "there is no module nowhere"),
        (Settings(success_function="fakes:never"), "not true at the goal itself"),
        (Settings(success_function="fakes:limited"), "fails on two goals of shape"),
    ],
)
def test_what_cannot_be_the_rule_is_refused(settings: Settings, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        plane(settings)


def test_info_that_contradicts_the_rule_later_stops_the_run() -> None:
    foreign = describe(fakes.limited, None, {"word": "success"})
    lying = describe(
        fakes.limited, Settings(success_distance=0.5), {"lies": True, "word": "success"}
    )
    env = ForeignVectorEnv(Foreign(lying.source, foreign.spec), 4)
    env.reset(seed=0)

    def run() -> None:
        for _ in range(200):
            _, _, terminated, truncated, _ = env.step(np.full((4, 2), 0.5, np.float32))
            if (terminated | truncated).any():
                env.reset(options={"reset_mask": terminated | truncated})

    with pytest.raises(ConfigurationError, match="not a matter of the two goals alone"):
        run()


def test_a_threshold_that_belongs_to_success_is_kept() -> None:
    def question(achieved: Any, desired: Any) -> Any:
        return np.linalg.norm((achieved - desired)[:, :2], axis=1) <= 0.25

    goals = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]])
    found = deciding._ball(question, goals)
    assert found is not None
    assert found.groups == ((0, 1),)
    assert found(np.array([[0.25, 0, 9]]), np.zeros((1, 3)))[1].all()
    assert not found(np.array([[0.2501, 0, 9]]), np.zeros((1, 3)))[1].any()


@pytest.mark.parametrize(
    ("low", "high", "number"),
    [(0.446, 0.4507, 0.45), (0.9, 1.2, 1.0), (0.0496, 0.0501, 0.05), (1.24, 1.26, 1.25)],
)
def test_the_roundest_number_between_two(low: float, high: float, number: float) -> None:
    assert deciding.roundest(low, high) == number
