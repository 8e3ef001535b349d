"""Goal environments that are not midway's: stepped, ended, read, stored and trained on."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fakes
import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded

import midway
import tiny
from midway.envs.describing import Foreign, Settings, admit, describe, with_limit
from midway.envs.foreign import ForeignVectorEnv
from midway.envs.goals_in_info import GoalsInInfo
from midway.envs.sources import source
from midway.errors import BrokenEnvironmentError, ConfigurationError, NonFiniteError
from midway.training import seeds as midway_seeds

TINY = tiny.TINY | {"num_envs": 2, "random_steps": 20, "checkpoint_every": 60}
RIGHT = np.array([[1.0, 0.0], [1.0, 0.0]], np.float32)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("tests/Reach-v0", fakes.Plane, max_episode_steps=20)
    yield
    gymnasium.registry.pop("tests/Reach-v0")


def plane(settings: Settings | None = None, **options: Any) -> Foreign:
    return describe(fakes.limited, settings, options)


def run(env: ForeignVectorEnv, steps: int, seed: int = 0) -> list[Any]:
    """Return all that an environment shows in so many steps of random actions."""
    observation, _ = env.reset(seed=seed)
    shown = [observation]
    rngs = [np.random.default_rng(copy) for copy in range(env.num_envs)]
    for _ in range(steps):
        actions = np.stack([rng.uniform(-1, 1, 2) for rng in rngs]).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(actions)
        flags = {"terminated": terminated, "truncated": truncated, "failed": info["failed"]}
        shown.append(observation | flags | {"elapsed": info["elapsed_steps"]})
        if (terminated | truncated).any():
            shown.append(env.reset(options={"reset_mask": terminated | truncated})[0])
    env.close()
    return shown


def check_same(first: list[Any], second: list[Any], rows: slice = slice(None)) -> None:
    for one, other in zip(first, second, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name][rows], err_msg=name)


def test_actions_and_goals_are_the_environments_own() -> None:
    env = ForeignVectorEnv(plane(), 2)
    observation, info = env.reset(seed=0)
    start = observation["achieved_goal"].copy()
    observation, reward, _, _, info = env.step(np.array([[1, 0], [-1, 9]], np.float32))
    moved = observation["achieved_goal"] - start
    np.testing.assert_allclose(moved, [[0.25, 0], [-0.25, 0.25]], atol=1e-6)
    assert reward.tolist() == [-1.0, -1.0]
    assert observation["observation"].dtype == np.float32
    distance = np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"], axis=1)
    np.testing.assert_allclose(info["distance"], distance, rtol=1e-5)


def test_processes_show_what_one_process_shows() -> None:
    foreign = plane(ends="cliff", word="success")
    with_processes = ForeignVectorEnv(foreign, 5, num_threads=2)
    assert with_processes._workers is not None
    alone = ForeignVectorEnv(foreign, 5, num_threads=1)
    assert alone._workers is None
    check_same(run(alone, 60), run(with_processes, 60))


def test_a_batch_is_as_many_batches_of_one() -> None:
    # Ends differ between environments: only what happens before the first end is compared.
    foreign = plane(ends="own", reward="none", settings=Settings(success_distance=1e-6))
    together = run(ForeignVectorEnv(foreign, 3), 14)
    check_same(run(ForeignVectorEnv(foreign, 1), 14, seed=0), together, slice(0, 1))
    check_same(run(ForeignVectorEnv(foreign, 1), 14, seed=0), run(ForeignVectorEnv(foreign, 1), 14))


def test_an_ended_environment_must_be_reset_and_others_are_left_alone() -> None:
    env = ForeignVectorEnv(plane(ends="own", reward="none", settings=Settings(0.001)), 3)
    env.reset(seed=0)
    env.step(np.zeros((3, 2), np.float32))
    before = env._held["observation"].copy()
    observation, info = env.reset(options={"reset_mask": np.array([False, True, False])})
    same = (observation["observation"] == before.astype(np.float32)).all(1)
    assert same.tolist() == [True, False, True]
    assert info["elapsed_steps"].tolist() == [1, 0, 1]
    for _ in range(6):
        _, _, terminated, truncated, _ = env.step(np.zeros((3, 2), np.float32))
    assert truncated.tolist() == [True, False, True]
    assert not terminated.any()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((3, 2), np.float32))


@pytest.mark.parametrize("num_threads", [1, 2])
def test_who_rests_is_not_stepped_until_it_is_reset(num_threads: int) -> None:
    env = ForeignVectorEnv(plane(Settings(1e-6), reward="none"), 2, num_threads=num_threads)
    start = env.reset(seed=0)[0]["achieved_goal"]
    second = np.array([False, True])
    env.rest(second)
    for _ in range(20):
        observation, _, terminated, truncated, _ = env.step(RIGHT)
    moved = observation["achieved_goal"] - start
    np.testing.assert_allclose(moved, [[5, 0], [0, 0]], atol=1e-5)
    assert truncated.tolist() == [True, False]
    assert not terminated.any()
    env.reset(options={"reset_mask": np.array([True, True])})
    before = env._held["achieved_goal"].copy()
    env.step(RIGHT)
    assert (env._held["achieved_goal"] != before)[:, 0].all()
    env.close()


def test_an_end_without_success_is_a_failure() -> None:
    env = ForeignVectorEnv(plane(ends="cliff"), 2)
    env.reset(seed=1)
    for _ in range(12):
        _, _, terminated, truncated, info = env.step(RIGHT)
        over = np.abs(env._held["achieved_goal"][:, 0]) > 1.5
        np.testing.assert_array_equal(info["failed"], over & ~info["is_success"])
        np.testing.assert_array_equal(terminated, info["failed"] | info["is_success"])
        if info["failed"].any():
            break
        if (terminated | truncated).any():
            env.reset(options={"reset_mask": terminated | truncated})
    assert info["failed"].any()
    assert info["_failed"].all()


def test_an_end_by_success_is_none_and_by_time_is_truncation() -> None:
    shown = run(ForeignVectorEnv(plane(ends="success"), 4), 100)
    assert not any(row["failed"].any() for row in shown if "failed" in row)
    assert any(row["terminated"].any() for row in shown if "failed" in row)
    late = describe(fakes.limited, Settings(1e-6), {"ends": "time", "reward": "none"})
    failed = [row["failed"] for row in run(ForeignVectorEnv(late, 2), 10) if "failed" in row]
    assert failed[-1].all()
    # Terminated at the very limit is what older environments say of a time limit.
    at_limit = run(ForeignVectorEnv(with_limit(late, 10), 2), 10)
    assert at_limit[-2]["truncated"].all()
    assert not at_limit[-2]["failed"].any()


def test_what_the_environment_calls_success_is_no_failure() -> None:
    """A stricter rule of the user than the environment's, which ends its episodes."""
    strict = describe(fakes.limited, Settings(1e-6), {"ends": "success", "word": "success"})
    shown = [row for row in run(ForeignVectorEnv(strict, 4), 60) if "failed" in row]
    assert not any(row["failed"].any() or row["terminated"].any() for row in shown)
    assert any((row["truncated"] & (row["elapsed"] < 20)).any() for row in shown)


@pytest.mark.parametrize(
    ("form", "shape", "read", "dtype"),
    [
        ("dict", (), (5,), "float32"),
        ("same", (), (2,), "float32"),
        ("image", (84, 84, 3), (84, 84, 3), "uint8"),
        ("image", (48, 64, 3), (84, 84, 3), "uint8"),
        ("image", (3, 120, 160), (84, 84, 3), "uint8"),
        ("image", (200, 100), (84, 84, 3), "uint8"),
    ],
)
def test_observations_of_every_form(form: str, shape: Any, read: Any, dtype: str) -> None:
    foreign = describe(fakes.Seen, None, {"form": form, "shape": shape})
    assert foreign.spec.observation_shape == read
    assert foreign.spec.observation_dtype == dtype
    assert foreign.spec.goal_is_observation == (form != "dict")
    env = ForeignVectorEnv(foreign, 2)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    if form == "image":
        assert (observation["observation"] == 100).all()


def test_images_with_goals_of_numbers_are_refused() -> None:
    class Mixed(gymnasium.ObservationWrapper[Any, Any, Any]):
        def __init__(self) -> None:
            super().__init__(fakes.limited())
            image = spaces.Box(0, 255, (84, 84, 3), np.uint8)
            old: Any = self.env.observation_space
            self.observation_space = spaces.Dict({**old.spaces, "observation": image})

        def observation(self, observation: Any) -> Any:
            return {**observation, "observation": np.zeros((84, 84, 3), np.uint8)}

    with pytest.raises(ConfigurationError, match="observes images but its goals are numbers"):
        describe(Mixed)


def test_an_image_is_shrunk_by_means_over_its_pixels() -> None:
    from midway.envs.reading import readings

    goal = spaces.Box(-1, 1, (1,), np.float64)
    box = spaces.Box(0, 255, (168, 168, 1), np.uint8)
    space = spaces.Dict({"observation": box, "achieved_goal": goal, "desired_goal": goal})
    pixels = np.random.default_rng(0).integers(0, 256, (168, 168, 1), np.uint8)
    small = readings("x", space)["observation"].read(pixels)
    means = pixels.reshape(84, 2, 84, 2).mean((1, 3))
    assert np.abs(small - means[..., None]).max() <= 0.501


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"observation": spaces.Box(0, 255, (84, 84, 4), np.uint8)}, "images of 4 channels"),
        ({"achieved_goal": spaces.Discrete(3)}, "achieved_goal must be numbers"),
        ({"desired_goal": spaces.Box(-1, 1, (5,))}, "must have the same shape"),
        (
            dict.fromkeys(
                ("achieved_goal", "desired_goal"), spaces.Box(0, 255, (84, 84), np.uint8)
            ),
            "its goals are images.*observe achieved_state",
        ),
        ({"observation": spaces.Sequence(spaces.Discrete(2))}, "no fixed number of entries"),
    ],
)
def test_what_cannot_be_read_is_refused(change: dict[str, Any], reason: str) -> None:
    def made() -> Any:
        env = fakes.limited()
        env.unwrapped.observation_space = spaces.Dict({**env.observation_space.spaces, **change})
        return env

    with pytest.raises(ConfigurationError, match=reason):
        describe(made)


@pytest.mark.parametrize(
    ("space", "reason"),
    [
        (spaces.Discrete(4), r"its actions are Discrete\(4\)"),
        (spaces.MultiBinary(4), r"its actions are MultiBinary\(4\)"),
        (spaces.Box(-np.inf, np.inf, (2,)), "no bounds: give --action-bound B"),
    ],
)
def test_actions_that_are_no_numbers_within_bounds_are_refused(space: Any, reason: str) -> None:
    def made() -> Any:
        env = fakes.limited()
        env.unwrapped.action_space = space
        return env

    with pytest.raises(ConfigurationError, match=reason):
        describe(made)
    if isinstance(space, spaces.Box):
        env = ForeignVectorEnv(describe(made, Settings(action_bound=4.0)), 1)
        start = env.reset(seed=0)[0]["achieved_goal"]
        moved = env.step(np.array([[1, -0.5]], np.float32))[0]["achieved_goal"] - start
        np.testing.assert_allclose(moved, [[1, -0.5]], atol=1e-6)


def test_what_is_not_finite_stops_with_its_name() -> None:
    with pytest.raises(ConfigurationError, match=r"observation\[0\] is nan after 3 steps"):
        plane(broken_at=3)
    broken = Foreign(source(fakes.limited, {"broken_at": 3}), plane(Settings(1e-6)).spec)
    env = ForeignVectorEnv(broken, 2)
    env.reset(seed=0)
    env.step(0 * RIGHT)
    env.step(0 * RIGHT)
    with pytest.raises(NonFiniteError, match=r"environment 0, in step 3 .* not finite"):
        env.step(0 * RIGHT)


def test_all_that_was_decided_can_be_stored() -> None:
    foreign = plane(Settings(success_function=fakes.within, action_bound=2.0), word="success")
    again = Foreign.from_json(json.loads(json.dumps(foreign.to_json())))
    assert again.spec == foreign.spec
    assert again.source == foreign.source
    assert again.settings.success_function == "fakes:within"
    assert not again.rule_is_its_own
    check_same(run(ForeignVectorEnv(foreign, 2), 20), run(ForeignVectorEnv(again, 2), 20))
    with pytest.raises(ConfigurationError, match="cannot be read"):
        Foreign.from_json({"source": {}})


def test_pictures_of_the_environments() -> None:
    env = ForeignVectorEnv(plane(), 2, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(RIGHT)
    pictures = env.render()
    assert pictures is not None
    assert [picture.mean() for picture in pictures] == [1, 1]
    assert ForeignVectorEnv(plane(), 2).render() is None


SCRIPT = """
import sys, time
import numpy as np, gymnasium
sys.path.insert(0, {folder!r})
import fakes
from midway.envs.describing import describe
from midway.envs.foreign import ForeignVectorEnv

class Mine(fakes.Plane):
    "A class of the script itself, which no process can import."

def make():
    return gymnasium.wrappers.TimeLimit(Mine(), 20)

env = ForeignVectorEnv(describe(make), 4, num_threads=2)
env.reset(seed=0)
print(*[process.pid for process in env._workers._vector.processes], flush=True)
input()
{end}
"""


def start(end: str) -> tuple[subprocess.Popen[str], list[int]]:
    """Run a script without ``if __name__``; return it and the processes that it started."""
    text = SCRIPT.format(folder=str(Path(fakes.__file__).parent), end=textwrap.dedent(end))
    script = subprocess.Popen(
        [sys.executable, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert script.stdout is not None
    return script, [int(pid) for pid in script.stdout.readline().split()]


def alive(pids: list[int]) -> list[int]:
    """Return which of the processes still run, after a while in which they may end."""
    for _ in range(100):
        running = [pid for pid in pids if Path(f"/proc/{pid}").exists()]
        if not running:
            return []
        time.sleep(0.1)
    return running


@pytest.mark.parametrize("end", ["env.close()", "", "raise SystemExit(0)"])
def test_processes_end_with_the_script_and_leave_signals_to_it(end: str) -> None:
    script, workers = start("env.step(np.zeros((4, 2), np.float32))\n" + end)
    assert len(workers) == 2
    for pid in workers:  # as Ctrl-C, timeout and job schedulers do: everyone gets the signal
        os.kill(pid, signal.SIGTERM)
        os.kill(pid, signal.SIGINT)
    script.communicate("\n", timeout=60)
    assert script.returncode == 0
    assert alive(workers) == []


def test_processes_end_when_the_script_is_killed() -> None:
    script, workers = start("")
    script.kill()
    script.communicate(timeout=60)
    assert alive(workers) == []


def test_a_process_that_is_gone_is_told() -> None:
    env = ForeignVectorEnv(plane(), 2, num_threads=2)
    env.reset(seed=0)
    assert env._workers is not None
    victim = env._workers._vector.processes[0]
    victim.kill()
    victim.join()
    with pytest.raises(RuntimeError, match="a process that steps environments has ended"):
        env.step(RIGHT)
    env.close()


def test_what_breaks_in_another_process_is_named_and_made_anew() -> None:
    env = ForeignVectorEnv(describe(fakes.obedient, Settings(1e-6)), 2, num_threads=2)
    env.reset(seed=0)
    env.step(0 * RIGHT)
    with pytest.raises(BrokenEnvironmentError, match=named("ValueError: the\nsimulator")) as error:
        env.step(np.array([[0, 0], fakes.RAISES], np.float32))
    shown, _, _, truncated, info = error.value.step
    assert info["broken"].tolist() == truncated.tolist() == [False, True]
    assert np.isfinite(shown["observation"]).all()
    env.reset(options={"reset_mask": info["broken"]})
    env.step(0 * RIGHT)
    for action, said in ((fakes.EXITS, "process .* has ended"), (fakes.HANGS, "no answer in 4 s")):
        assert env._workers is not None
        env._workers.limit = 4.0
        with pytest.raises(BrokenEnvironmentError, match=named(said)) as error:
            env.step(np.array([[0, 0], action], np.float32))
        assert error.value.step is None
        env._workers.limit = 600.0
        env.reset()
        env.step(0 * RIGHT)
    env.close()


def named(said: str) -> str:
    """Return a pattern of copy, step, episode, action and reason."""
    return (
        rf"(?s)obedient: environment 1, in step \d of its episode \d, after action \[.*\]: .*{said}"
    )


@pytest.mark.parametrize("agent", ["ris", "sac"])
def test_train_resume_and_evaluate(tmp_path: Path, agent: str) -> None:
    name = "tests/Reach-v0"
    made = midway.train(name, agent=agent, steps=60, out=tmp_path / "run", changes=TINY)
    assert made.finished
    assert midway.resume(made.path, steps=120).finished
    result = midway.evaluate(made.path, episodes=3)
    assert result.task == "uniform"
    assert len(result.episodes) == 3
    policy = midway.load(made.path)
    action = policy(np.zeros(4, np.float32), np.zeros(2, np.float32))
    assert action.shape == (2,)
    env = gymnasium.make(name)
    shown, _ = env.reset(seed=0)
    own = policy.predict(shown)
    assert env.action_space.contains(own)
    pair = [shown[key].astype(np.float32) for key in ("observation", "desired_goal")]
    np.testing.assert_allclose(own, policy(*pair), rtol=1e-5)


def test_success_is_what_the_environment_says_in_a_loop_of_its_own(tmp_path: Path) -> None:
    """The reward is 1 at the goal, 0 elsewhere, and the episode goes on there."""
    env = midway.goal_env(fakes.limited, kwargs={"reward": "plus"})
    run = midway.train(env, agent="sac", steps=60, out=tmp_path / "run", changes=TINY)
    policy, found = midway.load(run.path), midway.evaluate(run.path, episodes=12, seed=3).episodes
    vector, single = midway.make_vec(env, num_envs=12), fakes.limited(reward="plus")
    starts, _ = vector.reset(seed=midway_seeds.evaluation(3))
    assert 0 < sum(episode.success for episode in found) < 12
    for number, episode in enumerate(found):
        single.reset(seed=0)
        plane = single.unwrapped
        plane.place = starts["achieved_goal"][number].astype(np.float64)
        plane.goal = starts["desired_goal"][number].astype(np.float64)
        said, seen = False, np.concatenate([plane.place, np.zeros(2)])
        length = 0
        while length < 20 and not said:
            length += 1
            action = policy(seen.astype(np.float32), starts["desired_goal"][number])
            shown, *_ = single.step(action)
            seen = shown["observation"]
            said = plane.compute_reward(shown["achieved_goal"], shown["desired_goal"], {}) == 1
        assert (said, length) == (episode.success, episode.length)


def test_a_state_tells_its_goal_and_how_far_states_vary() -> None:
    whole = plane().spec
    assert whole.observation_shape == (4,)
    assert whole.goal_coordinates == (0, 1)
    assert whole.spread[0] == whole.spread[1] > 0.1
    seen = describe(fakes.Seen, None, {"form": "dict"})
    # "at" and one of three categories, of which two never show; "at" is the goal
    assert (seen.spec.goal_coordinates, seen.spec.spread[3:]) == ((0, 1), (1.0, 1.0))
    hidden = describe(fakes.Hidden)
    assert hidden.spec.observation_shape == (4,)
    assert hidden.spec.goal_coordinates == (2, 3)
    observation, _ = ForeignVectorEnv(hidden, 3).reset(seed=0)
    np.testing.assert_array_equal(observation["observation"][:, 2:], observation["achieved_goal"])


def told_in_two_coordinates() -> Any:
    return GoalsInInfo(fakes.Told(), (0, 1))


def test_goals_that_are_told_in_info_as_in_ogbench() -> None:
    single = GoalsInInfo(fakes.Told())
    shown, info = single.reset(seed=3)
    np.testing.assert_array_equal(shown["desired_goal"], info["goal"])
    np.testing.assert_array_equal(shown["achieved_goal"], shown["observation"])
    after, *_ = single.step(np.array([1.0, 0.0], np.float32))
    np.testing.assert_array_equal(after["desired_goal"], info["goal"])
    foreign = describe(told_in_two_coordinates, Settings(success_distance=fakes.RADIUS))
    assert (foreign.spec.goal_shape, foreign.spec.goal_coordinates) == ((2,), (0, 1))
    shown = run(ForeignVectorEnv(foreign, 3), 30)
    assert any(row["terminated"].any() for row in shown if "terminated" in row)
    with pytest.raises(ConfigurationError, match="info has no goal"):
        GoalsInInfo(gymnasium.make("Pendulum-v1")).reset()
    with pytest.raises(ConfigurationError, match="need a vector"):
        GoalsInInfo(fakes.limited())


def test_what_is_no_environment_is_refused_by_name() -> None:
    with pytest.raises(ConfigurationError, match="no goal environment"):
        midway.make_vec("Pendulum-v1")
    with pytest.raises(ConfigurationError, match=r"unknown environment 'Nowhere-v0'.*point-u"):
        midway.make_vec("Nowhere-v0")


def test_what_was_described_goes_by_its_name() -> None:
    foreign = describe(lambda: fakes.limited(), Settings(0.7))
    assert midway.make_vec(foreign).goal_spec == foreign.spec
    admit(foreign)
    assert midway.make_vec(foreign.spec.name).goal_spec.task.threshold == 0.7
