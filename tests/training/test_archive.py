"""States are written and read array by array, and nothing is taken for what it is not."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.errors import ConfigurationError
from midway.training import archive

STATE = {
    "agent": {
        "policy.weight": jnp.arange(6, dtype=jnp.bfloat16).reshape(2, 3),
        "count": jnp.array(3),
    },
    "replay": {"images": np.zeros((50, 84, 84, 3), np.uint8), "none": np.zeros((0, 4))},
    "nothing": {},
    "flags": np.array([True, False]),
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    archive.write(tmp_path / "state.npz", STATE)
    return tmp_path / "state.npz"


def test_what_was_written_is_read_bit_for_bit(file: Path) -> None:
    like = jax.tree.map(
        lambda leaf: (np if isinstance(leaf, np.ndarray) else jnp).zeros_like(leaf), STATE
    )
    found = archive.read(file, like)
    assert jax.tree.structure(found) == jax.tree.structure(STATE)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(STATE), strict=True):
        assert type(one) is type(other)
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


def test_the_file_is_a_function_of_the_state(file: Path) -> None:
    again = file.with_name("again.npz")
    archive.write(again, STATE)
    assert again.read_bytes() == file.read_bytes()


def test_others_can_read_it(file: Path) -> None:
    with np.load(file) as arrays:
        np.testing.assert_array_equal(arrays["flags"], STATE["flags"])
        assert arrays["agent/count"] == 3


def test_images_are_compressed(file: Path) -> None:
    assert file.stat().st_size < STATE["replay"]["images"].nbytes / 20


@pytest.mark.parametrize(
    ("name", "like", "reason"),
    [
        ("flags", np.zeros(3, np.bool_), r"expected bool\(3,\), found bool\(2,\)"),
        ("flags", np.zeros(2, np.int8), "expected int8"),
        ("other", np.zeros(2), "other.npy"),
        ("replay", {"images": np.zeros(4, np.uint8)}, "bytes, expected 4"),
    ],
)
def test_other_arrays_are_refused_by_name(file: Path, name: str, like: object, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        archive.read(file, {name: like})
