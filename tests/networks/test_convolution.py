"""Convolutions as products: values and gradients are those of XLA's own convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.networks.convolution import (
    BLOCK,
    Filter,
    convolution,
    in_blocks,
    transposed_convolution,
)

KEY = jax.random.key(0)
SIZES = [(84, 3, 2, 3), (41, 3, 2, 32), (20, 3, 2, 32), (9, 3, 1, 32), (27, 5, 3, 4), (7, 2, 3, 2)]
"""Side of the image, kernel, stride and channels."""


def reference(image, weight, stride):
    layout = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(
        image, weight, (stride, stride), "VALID", dimension_numbers=layout
    )


def drawn(side, kernel, channels):
    image_key, weight_key = jax.random.split(KEY)
    image = jax.random.normal(image_key, (2, side, side + 1, channels))
    return image, jax.random.normal(weight_key, (kernel, kernel, channels, 5))


def test_convolution_by_hand():
    image = jnp.arange(9.0).reshape(1, 3, 3, 1)
    weight = jnp.array([[1.0, 10.0], [100.0, 1000.0]]).reshape(2, 2, 1, 1)
    expected = [[4310, 5421], [7643, 8754]]
    np.testing.assert_allclose(convolution(image, weight, 1, "f32")[0, ..., 0], expected)


@pytest.mark.parametrize(("side", "kernel", "stride", "channels"), SIZES)
def test_convolution_and_gradients_are_xlas(side, kernel, stride, channels):
    image, weight = drawn(side, kernel, channels)
    value, pull = jax.vjp(lambda x, w: convolution(x, w, stride, "f32"), image, weight)
    expected, expected_pull = jax.vjp(lambda x, w: reference(x, w, stride), image, weight)
    np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-4)
    upstream = jax.random.normal(KEY, value.shape)
    for found, wanted in zip(pull(upstream), expected_pull(upstream), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(("side", "kernel", "stride", "channels"), SIZES)
def test_transposed_convolution_is_the_gradient_of_a_convolution(side, kernel, stride, channels):
    image, weight = drawn(side, kernel, channels)
    value, pull = jax.vjp(lambda x: reference(x, weight, stride), image)
    upstream = jax.random.normal(KEY, value.shape)
    found = transposed_convolution(upstream, weight.swapaxes(2, 3), stride)
    expected = pull(upstream)[0][:, : found.shape[1], : found.shape[2]]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


def test_bfloat16_rounds_only_the_inputs_of_products():
    image, weight = drawn(21, 3, 4)
    value, pull = jax.vjp(lambda x, w: convolution(x, w, 2, "bf16"), image, weight)
    exact, exact_pull = jax.vjp(lambda x, w: convolution(x, w, 2, "f32"), image, weight)
    assert value.dtype == jnp.float32
    for found, wanted in zip((value, *pull(exact)), (exact, *exact_pull(exact)), strict=True):
        assert found.dtype == jnp.float32
        error = jnp.linalg.norm(found - wanted) / jnp.linalg.norm(wanted)
        assert 0 < error < 0.01


def test_filters_add_their_bias():
    layer = Filter(3, 2, 2, 5, key=KEY)
    zeros = jnp.zeros((1, 9, 9, 2))
    np.testing.assert_allclose(layer.reduce(zeros), jnp.broadcast_to(layer.bias, (1, 4, 4, 5)))
    np.testing.assert_allclose(layer.enlarge(zeros)[0, 0, 0], layer.bias)


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, 2 * BLOCK + 3])
def test_blocks_change_neither_values_nor_gradients(count):
    rows = jax.random.normal(KEY, (count, 4))
    weight = jax.random.normal(KEY, (4, 3))

    def blocked(weight):
        return in_blocks(lambda block: jnp.tanh(block @ weight), rows)

    def plain(weight):
        return jnp.tanh(rows @ weight)

    np.testing.assert_allclose(blocked(weight), plain(weight), rtol=1e-5, atol=1e-6)
    gradients = [jax.grad(lambda w, f=f: (f(w) ** 2).sum())(weight) for f in (blocked, plain)]
    np.testing.assert_allclose(*gradients, rtol=1e-4, atol=1e-5)
