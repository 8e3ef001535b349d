"""The decoder of a run's policy: fitted on the side, kept in its folder, made anew when due."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from untrained import save_untrained

from drawing_here import needs_renderer
from midway import api
from midway.envs.registry import make_vec
from midway.reports import decoder
from midway.runs.folder import RunFolder

pytestmark = needs_renderer


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Return the folder of an agent on images that has learned nothing yet."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "push")
    changes = {"hidden": (8,), "num_envs": 1, "replay_capacity": 300, "random_steps": 10}
    config = api.configure("push", "sac", changes=changes)
    save_untrained(folder, config, 50)
    return folder


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"IMAGES": 60, "NUM_ENVS": 5, "UPDATES": 2, "UPDATES_PER_CALL": 2, "BATCH_SIZE": 4}
    for name, value in small.items():
        monkeypatch.setattr(decoder, name, value)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list that grows with every decoder that is fitted."""
    calls: list[Any] = []
    fit: Callable[..., Any] = decoder.fit

    def counted(*arguments: Any) -> Any:
        calls.append(fit(*arguments))
        return calls[-1]

    monkeypatch.setattr(decoder, "fit", counted)
    return calls


def of(folder: RunFolder, changed: Any = None) -> Any:
    return decoder.of_policy(folder, changed or api.load(folder.path))


def test_a_decoder_is_kept_and_made_anew_only_for_another_policy(
    saved: RunFolder, fits: list[Any]
) -> None:
    before = saved.policy_weights.read_bytes()
    first, second = of(saved), of(saved)
    assert len(fits) == 1
    assert eqx.tree_equal(first, second)
    assert saved.policy_weights.read_bytes() == before
    loaded = api.load(saved.path)
    later = of(saved, replace(loaded, step=60))
    assert len(fits) == 2
    assert eqx.tree_equal(first, later)  # the same features, the same seed
    doubled = jax.tree.map(lambda x: 2 * x, eqx.filter(loaded.state.encoder, eqx.is_array))
    changed = of(saved, replace(loaded, encoder=eqx.combine(doubled, loaded.state.encoder)))
    assert len(fits) == 3
    assert not np.allclose(changed.scale, first.scale)
    assert not list(saved.path.glob("*.new"))


@pytest.mark.parametrize("content", [b"", b"no weights"])
def test_a_damaged_decoder_is_made_anew(saved: RunFolder, fits: list[Any], content: bytes) -> None:
    file = saved.path / "decoder.safetensors"
    file.write_bytes(content)
    of(saved)
    assert len(fits) == 1
    assert file.stat().st_size > 10_000


def test_images_are_of_starts_goals_and_random_actions() -> None:
    env = make_vec("push", num_envs=3)
    images = decoder.sample_images(env, 14, seed=5)
    assert images.shape == (14, 84, 84, 3)
    observation, _ = make_vec("push", num_envs=3).reset(seed=5)
    np.testing.assert_array_equal(images[:3], observation["observation"])
    moved = (images[3:6] != images[:3]).any((1, 2, 3))
    assert moved.all()
    env = make_vec("push", num_envs=3)
    np.testing.assert_array_equal(images, decoder.sample_images(env, 14, seed=5))


def test_a_policy_of_states_has_no_image_encoder(tmp_path: Path, saved: RunFolder) -> None:
    assert decoder.encoder_of(api.load(saved.path)) is not None
    folder = RunFolder(tmp_path / "state")
    config = api.configure("push-state", "sac", changes={"hidden": (8,), "num_envs": 1})
    save_untrained(folder, config, 50)
    assert decoder.encoder_of(api.load(folder.path)) is None
