"""Training from images: it runs, and a stopped and resumed run equals one never stopped."""

import csv
import signal
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from small import SMALL

import midway
from drawing_here import needs_renderer
from midway.envs.push import IMAGE_SPEC
from midway.replay import buffer
from midway.training import loop
from midway.training.state import Training

pytestmark = pytest.mark.usefixtures("short_episodes")

IMAGES = SMALL | {"encoder_batch_size": 4}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [
            {name: value for name, value in row.items() if "seconds" not in name}
            for row in csv.DictReader(file)
        ]


@needs_renderer
def test_exact_resume_with_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped after the twelfth update: the replay holds features since the eighth."""
    changes = IMAGES | {"freeze_encoder_after": 8}
    whole = midway.train("push", seed=1, out=tmp_path / "whole", changes=changes)
    advance = loop.advance

    def interrupted(training: Training) -> None:
        advance(training)
        if training.counters.steps == 44:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "advance", interrupted)
        run = midway.train("push", seed=1, out=tmp_path / "run", changes=changes)
    assert not run.finished
    assert midway.resume(run.path).finished
    for name in ("metrics.csv", "evaluation.csv"):
        assert rows(run.path / name) == rows(whole.path / name)
        assert rows(run.path / name)
    weights = [(r.path / "policy.safetensors").read_bytes() for r in (run, whole)]
    assert weights[0] == weights[1]


@needs_renderer
def test_a_saved_policy_acts_on_images(tmp_path: Path) -> None:
    run = midway.train("push", seed=1, out=tmp_path / "run", changes=IMAGES | {"steps": 30})
    policy = midway.load(run.path)
    observation, _ = midway.make_vec("push", num_envs=2).reset(seed=0)
    actions = policy(observation["observation"], observation["desired_goal"])
    assert np.asarray(actions).shape == (2, 2)
    assert np.abs(actions).max() <= 1


@needs_renderer
def test_leap_learns_from_the_latents_of_images(tmp_path: Path) -> None:
    """Its encoder is frozen before the first update, which donates the arrays of its state."""
    few = {"vae_states": 100, "vae_rounds": 1, "vae_updates": 2, "vae_batch_size": 2}
    plan = {"num_subgoals": 1, "plan_samples": 2, "plan_iterations": 1, "plan_elites": (0.5,)}
    run = midway.train(
        "push", agent="leap", seed=1, out=tmp_path / "run", changes=IMAGES | few | plan
    )
    assert run.finished
    assert midway.evaluate(run.path, episodes=1).episodes
    kept = midway.load(run.path)
    image = midway.make_vec("push", num_envs=1).reset(seed=0)[0]["observation"]
    latent = kept.state.vae.encode(jnp.asarray(image)).mean
    np.testing.assert_array_equal(kept.encoder(jnp.asarray(image)), latent)


def test_a_hundred_thousand_transitions_keep_each_image_once() -> None:
    held = buffer.memory_bytes(IMAGE_SPEC, capacity=102_000, num_lanes=8)
    assert held < 2.3 * 2**30
    assert held > 102_000 * 84 * 84 * 3
    kinds = buffer.create(IMAGE_SPEC, 1_700, 8).rows
    assert kinds["observation"].dtype == jnp.uint8
    assert "achieved_goal" not in kinds
