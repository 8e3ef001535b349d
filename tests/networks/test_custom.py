"""Networks of a user's own: made by name, kept in the run folder, refused with one line."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import midway
from midway.errors import ConfigurationError
from midway.networks.custom import create
from midway.networks.mlp import Linear

pytestmark = pytest.mark.usefixtures("short_episodes")

TINY = {
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 20,
    "replay_capacity": 2_000,
    "evaluation_episodes": 2,
    "steps": 40,
    "network": "users_networks:residual",
}


class Residual(eqx.Module):
    """One layer, and the input beside it."""

    inner: Linear
    outer: Linear

    def __call__(self, x: Any) -> Any:
        """Return the output ``(*B, O)``."""
        return self.outer(jnp.concatenate([x, jax.nn.gelu(self.inner(x))], axis=-1))


def residual(in_size: int, out_size: int, *, key: Any) -> Residual:
    keys = jax.random.split(key)
    inner = Linear(in_size, 8, "f32", key=keys[0])
    return Residual(inner, Linear(in_size + 8, out_size, "f32", key=keys[1]))


def whole(in_size: int, out_size: int, *, key: Any) -> Any:
    return lambda x: x


def flat(in_size: int, out_size: int, *, key: Any) -> Any:
    return lambda x: x.reshape(3, in_size)[:, :out_size]


@pytest.fixture(autouse=True)
def users_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("users_networks")
    module.residual, module.whole, module.flat, module.number = residual, whole, flat, 3
    monkeypatch.setitem(sys.modules, "users_networks", module)


def test_a_run_trains_with_them_and_its_policy_loads(tmp_path: Path) -> None:
    run = midway.train("point-u", agent="ris", out=tmp_path / "run", changes=TINY)
    policy: Any = midway.load(run.path)
    state = policy.state
    made = (state.policy, state.prior_policy, state.subgoal_policy)
    assert all(isinstance(part.network.module, Residual) for part in made)
    assert isinstance(state.critic.first.module, Residual)
    pair = np.zeros((3, 4), np.float32), np.ones((3, 4), np.float32)
    assert policy(*pair).shape == (3, 2)
    assert midway.resume(run.path, steps=60).finished
    assert (midway.load(run.path)(*pair) != policy(*pair)).any()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("residual", "No module named 'residual'"),
        ("users_networks:nothing", "no attribute 'nothing'"),
        ("users_networks:number", "is a int, not a function"),
        ("users_networks:whole", r"makes float32 \(3, 5\) of \(3, 5\): must be float32 \(3, 2\)"),
        ("users_networks:flat", r"on \(3, 2, 5\): TypeError"),
    ],
)
def test_what_makes_no_network_is_refused(name: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        create(name, (5, (), 2), "f32", key=jax.random.key(0))
