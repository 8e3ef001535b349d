"""What the measurements count; no time is looked at."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drawing_here import needs_renderer
from midway import api
from midway.bench import pieces as bench
from midway.bench import plan as bench_plan
from midway.envs.push import IMAGE_SPEC
from midway.replay import buffer
from midway.runs.folder import RunFolder
from midway.training import state as states
from midway.training import step
from midway.training.compilation import give_back_memory

MIB = 2**20


def test_a_replay_of_images_takes_its_arrays_and_no_more() -> None:
    """Written in place: the process grows by the ring, when it is made and after many steps."""
    before, _ = bench.resident_bytes()
    replay = jax.block_until_ready(buffer.create(IMAGE_SPEC, 8_000, 8))
    size = buffer.memory_bytes(IMAGE_SPEC, 8_000, 8)
    image = np.full((8, *IMAGE_SPEC.observation_shape), 7, np.uint8)
    state = np.zeros((8, 4), np.float32)
    observation = {"observation": image, "achieved_state": state}
    goal = {"desired_goal": image, "desired_state": state}
    everyone, actions = np.ones(8, np.bool_), np.zeros((8, IMAGE_SPEC.action_dim), np.float32)
    replay = step.begin(replay, {**observation, **goal}, everyone)
    for _ in range(1_100):
        replay = step.add(replay, actions, observation, everyone)
    jax.block_until_ready(replay)
    now, most = bench.resident_bytes()
    assert size > 150 * MIB
    assert 0.95 * size < now - before < 1.05 * size + 60 * MIB
    assert most >= now


def test_products_are_counted_inside_loops_and_gradients() -> None:
    weight = jnp.ones((3, 5))

    def loss(x: jax.Array) -> jax.Array:
        return jax.lax.map(lambda row: (row @ weight).sum(), x).sum()

    x = jnp.ones((7, 2, 3))
    forward = 2 * 7 * 2 * 3 * 5
    assert bench._product_flops(loss, (x,)) == forward
    assert bench._product_flops(jax.grad(loss), (x,)) == 2 * forward


def test_machine_says_what_figures_depend_on() -> None:
    found = bench.machine()
    assert found["threads"] == found["cores"] >= 1
    assert found["devices"] == len(jax.devices())
    assert {"jax", "mujoco", "midway"} <= set(found["versions"])
    assert {"processor", "device", "flags", "python"} <= set(found)


@needs_renderer
def test_an_update_of_images_is_timed_on_their_features_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(bench, "ROWS", 2_000)
    monkeypatch.setattr(bench, "IMAGE_ROWS", 400)
    found = bench.update("push", "sac", 4, "f32")
    assert found["update_on_features_ms"] > 0
    assert found["update_ms"] > 0


def test_noise_fills_the_replay() -> None:
    config = api.configure("point-u", "sac", changes={"num_envs": 4, "replay_capacity": 2_000})
    training = states.start(api.setup_of(config, RunFolder(Path("unused"))))
    bench._fill_with_noise(training)
    assert int(buffer.num_transitions(training.replay)) > 1_000
    assert training.counters.steps == training.setup.train.random_steps


def test_freed_memory_goes_back_to_the_system() -> None:
    blocks = [bytearray(1_000) for _ in range(100_000)]
    last = bytearray(1_000)
    full, _ = bench.resident_bytes()
    del blocks
    give_back_memory()
    now, _ = bench.resident_bytes()
    assert full - now > 50 * MIB
    assert len(last) == 1_000


def test_a_plan_is_timed_with_the_sizes_asked_for() -> None:
    found = bench_plan.plan("point-u", "f32", samples=32, subgoals=2)
    assert (found["samples"], found["iterations"], found["subgoals"]) == (32, 50, 2)
    assert found["plan_s"] > 0
