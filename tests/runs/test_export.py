"""Exported policies act as they do in JAX, without it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import midway
from midway import configuration
from midway.agents import registry
from midway.errors import ConfigurationError
from midway.runs import export, export_onnx
from midway.runs.policy import Policy
from midway.training.step import create_state


def untrained(env: str, agent: str, **changes: Any) -> Policy:
    small = {"hidden": (8, 8), "precision": "f32"}  # on any machine
    config = configuration.configure(env, agent, changes=small | changes)
    spec, made = midway.make_vec(env).goal_spec, registry.get(agent)
    state = create_state(made, config.hyperparameters, spec, jax.random.key(1))
    return Policy(made, state, config, spec, 7)


def shown(policy: Policy, count: int) -> dict[str, Any]:
    rng, spec = np.random.default_rng(2), policy.spec
    shapes = {"observation": spec.observation_shape}
    shapes |= dict.fromkeys(("achieved_goal", "desired_goal"), spec.goal_shape)
    return {
        name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in shapes.items()
    }


@pytest.mark.parametrize(
    ("env", "agent"), [("point-u", "sac"), ("ant-u", "ris"), ("push-state", "crl")]
)
def test_the_module_acts_as_the_policy(env: str, agent: str, tmp_path: Path) -> None:
    policy = untrained(env, agent)
    numpy = export.write_numpy(policy, tmp_path / "policy.py")
    batch = shown(policy, 5)
    expected = policy.predict(batch)
    np.testing.assert_allclose(numpy(batch), expected, atol=1e-5)
    single = {name: rows[3] for name, rows in batch.items()}
    np.testing.assert_allclose(numpy(single), expected[3], atol=1e-5)
    assert export.check(policy, numpy) < 1e-5
    with pytest.raises(ConfigurationError, match="off by"):
        export.check(policy, lambda observation: numpy(observation) + 0.1)


@pytest.mark.extra
@pytest.mark.parametrize(("env", "agent"), [("point-u", "crl"), ("ant-u", "ris")])
def test_the_model_acts_as_the_policy(env: str, agent: str, tmp_path: Path) -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    policy = untrained(env, agent)
    export.check(policy, export_onnx.write_onnx(policy, tmp_path / "policy.onnx"))
    model = onnx.load(tmp_path / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    batch = shown(policy, 5)
    (found,) = ReferenceEvaluator(model).run(["action"], batch)
    np.testing.assert_allclose(found, policy.predict(batch), atol=1e-5)


def test_products_in_bfloat16_are_exported_in_float32(tmp_path: Path) -> None:
    policy = untrained("point-u", "sac", precision="bf16")
    off = export.check(policy, export.write_numpy(policy, tmp_path / "policy.py"))
    assert 0 < off < export.ROUNDING["bf16"]


def test_the_module_needs_numpy_alone(tmp_path: Path) -> None:
    policy = untrained("point-u", "sac")
    export.write_numpy(policy, tmp_path / "policy.py")
    batch = shown(policy, 2)
    np.savez(tmp_path / "shown.npz", **batch)
    program = (
        "import sys, numpy as np, policy; a = policy.act(dict(np.load('shown.npz')));"
        "assert not {'jax', 'midway'} & set(sys.modules); print(*a.ravel().tolist())"
    )
    said = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    found = np.array(said.stdout.split(), np.float32).reshape(2, 2)
    np.testing.assert_allclose(found, policy.predict(batch), atol=1e-5)


def test_what_cannot_be_exported_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="tdm remembers its episode"):
        export.program_of(untrained("point-u", "tdm"))
    with pytest.raises(ConfigurationError, match="push is seen in images"):
        export.program_of(untrained("push", "sac"))
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'midway\[onnx\]'"):
        export_onnx.write_onnx(untrained("point-u", "sac"), Path("unused"))
