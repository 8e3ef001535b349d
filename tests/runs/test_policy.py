"""Saved policies and configurations: without an environment, there and back, and of format 1."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import midway
import tiny
from midway import api, files
from midway.envs import registry
from midway.envs.push import IMAGE_SPEC, STATE_SPEC
from midway.errors import ConfigurationError
from midway.runs.folder import FORMAT, RunConfig, RunFolder
from midway.training.arrays import checked_arrays, save_arrays
from midway.types import EnvSpec, UnknownTask

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
TINY = tiny.TINY | {"steps": 80}


def test_a_policy_loads_without_an_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = midway.train("point-u", agent="sac", out=tmp_path / "run", changes=TINY)
    spec = midway.make_vec("point-u").goal_spec

    def no_environment(*arguments: Any, **options: Any) -> Any:
        raise AssertionError("an environment was made")

    monkeypatch.setattr(registry, "make_vec", no_environment)
    monkeypatch.setattr(registry.Declaration, "factory", no_environment)
    policy = midway.load(run.path)
    assert policy.spec == spec
    zeros = np.zeros((3, 4), np.float32)
    assert policy(zeros, zeros).shape == (3, 2)
    assert policy.value(zeros, zeros).shape == (3,)
    shown = {name: zeros for name in ("observation", "achieved_goal", "desired_goal")}
    np.testing.assert_array_equal(policy.predict(shown), policy(zeros, zeros))
    one = {name: batch[0] for name, batch in shown.items()}
    np.testing.assert_allclose(policy.predict(one), policy(zeros, zeros)[0], rtol=1e-6)
    drawn = policy.predict(shown, deterministic=False, seed=1)
    np.testing.assert_array_equal(drawn, policy.predict(shown, deterministic=False, seed=1))
    assert (drawn != policy.predict(shown, deterministic=False)).all()
    description = json.loads((run.path / "policy.json").read_text())
    later = files.sealed({**description, "format": FORMAT + 1})
    (run.path / "policy.json").write_text(json.dumps(later))
    with pytest.raises(ConfigurationError, match=f"format {FORMAT + 1}, expected 1 to {FORMAT}"):
        midway.load(run.path)


def test_target_networks_are_not_saved_and_do_no_harm_where_they_were(tmp_path: Path) -> None:
    run = midway.train("point-u", agent="ris", out=tmp_path / "run", changes=TINY)
    zeros = np.zeros((3, 4), np.float32)
    action, value = midway.load(run.path)(zeros, zeros), midway.load(run.path).value(zeros, zeros)
    file = RunFolder(run.path).policy_weights
    held, said = checked_arrays(file)
    parts = {name.split(".")[0] for name in held}
    assert parts == {"critic", "subgoal_policy", "policy"}
    copies = {f"target_{name}": array for name, array in held.items() if name.startswith("critic")}
    save_arrays(file, held | copies, {name: said[name] for name in ("run", "step")})
    before = midway.load(run.path)
    np.testing.assert_array_equal(before(zeros, zeros), action)
    np.testing.assert_array_equal(before.value(zeros, zeros), value)


SPECS = [
    IMAGE_SPEC,
    STATE_SPEC,
    IMAGE_SPEC.encoded(16),
    midway.make_vec("point-u").goal_spec,
    midway.make_vec("ant-u").goal_spec,
]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_specifications_come_back_from_their_files(spec: EnvSpec) -> None:
    assert EnvSpec.from_json(json.loads(json.dumps(spec.to_json()))) == spec


def test_a_rule_of_success_that_is_not_stored_judges_nothing() -> None:
    spec = replace(STATE_SPEC, task=UnknownTask())
    back = EnvSpec.from_json(json.loads(json.dumps(spec.to_json())))
    assert back == spec
    with pytest.raises(ConfigurationError, match="known to the environment alone"):
        back.task(np.zeros((1, 4)), np.zeros((1, 4)))


@pytest.mark.parametrize("values", [{}, {"task": None}, {"task": None, "nothing": 1}])
def test_specifications_that_are_not_understood_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="environment not understood"):
        EnvSpec.from_json(values)


# Those of ant-u-fast-trials have settings that only a modified copy of midway knew.
COMMITTED = [
    path
    for path in sorted(RESULTS.glob("*/*/config.json"))
    if json.loads(path.read_text()).get("format") == 1 and path.parts[-3] != "ant-u-fast-trials"
]


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_configurations_of_format_1_are_understood(path: Path) -> None:
    values = json.loads(path.read_text())
    assert values["format"] == 1
    config = RunFolder(path.parent).load_config()
    assert (config.env, config.agent, config.seed) == tuple(
        values[name] for name in ("env", "agent", "seed")
    )
    before = dict(values["hyperparameters"])
    assert config.train.freeze_encoder_after == before.pop("encoder_updates", 0)
    shift = before.pop("image_translation", None)
    found = json.loads(json.dumps(config.to_json()))
    assert shift is None or found["hyperparameters"]["random_shift"] == shift
    assert found["hyperparameters"].items() >= before.items()
    train = dict(values["train"])
    train["relabel"] = {**train["relabel"], "future_discount": 1.0}
    assert all(found["train"][name] == value for name, value in train.items())


def test_runs_with_a_setting_that_is_gone_are_read_but_not_continued(tmp_path: Path) -> None:
    run = midway.train("point-u", agent="sac", out=tmp_path / "run", changes=TINY)
    file = run.path / "config.json"
    values, config = json.loads(file.read_text()), RunFolder(run.path).load_config()

    def begun_with(on: bool) -> None:
        agent = {**values["hyperparameters"], "hindsight_bound": on}
        file.write_text(json.dumps(files.sealed({**values, "format": 3, "hyperparameters": agent})))
        assert RunFolder(run.path).load_config() == config

    begun_with(True)
    assert midway.load(run.path).step == TINY["steps"]
    with pytest.raises(ConfigurationError, match="learned with hindsight_bound=True"):
        midway.resume(run.path, steps=120)
    begun_with(False)
    assert midway.resume(run.path, steps=120).finished


@pytest.mark.parametrize("part", ["train", "hyperparameters"])
def test_nonsense_in_an_earlier_format_is_refused(part: str) -> None:
    values = {**api.configure("point-u", "sac").to_json(), "format": 1, part: "[60000, 60000]"}
    with pytest.raises(ConfigurationError, match="not understood"):
        RunConfig.from_json(values)


def test_there_are_configurations_of_format_1() -> None:
    assert len(COMMITTED) > 6
