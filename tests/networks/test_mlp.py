"""Layers: the original's start, broadcasting inputs, products in both precisions."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from midway.networks.mlp import MLP, Linear, Precision, bf16_product


def normal(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def rounded(x: jax.Array) -> np.ndarray:
    """Return x rounded to the nearest bfloat16, to even at a tie, with NumPy's integers."""
    bits = np.asarray(x).view(np.uint32).astype(np.uint64)
    bits = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
    return bits.astype(np.uint32).view(np.float32).astype(np.float64)


@functools.cache
def network_of(precision: Precision) -> MLP:
    """Return a network of a state of 3, a subgoal of 4, an action of 2; 5 outputs."""
    return MLP(9, (16, 16), 5, precision, key=jax.random.key(0))


@pytest.fixture(params=["f32", "bf16"])
def network(request) -> MLP:
    return network_of(request.param)


def test_linear_starts_uniform_within_one_over_root_of_its_inputs():
    """The bound is that of the original framework's layers, for weights and biases alike."""
    layer = Linear(100, 512, "f32", key=jax.random.key(1))
    bound = 0.1
    assert layer.weight.shape == (100, 512)
    assert layer.bias.shape == (512,)
    for array in (layer.weight, layer.bias):
        assert array.dtype == jnp.float32
        assert abs(array).max() <= bound
        assert abs(array).max() > 0.98 * bound
        assert array.std() == pytest.approx(bound / 3**0.5, rel=0.1)
    assert abs(layer.weight.mean()) < 0.05 * bound


def test_layers_start_different():
    network = MLP(16, (16, 16), 16, "f32", key=jax.random.key(0))
    weights = [np.asarray(layer.weight) for layer in network.layers]
    assert not np.array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[1], weights[2])


def test_mlp_is_relu_between_affine_layers():
    network = network_of("f32")
    x = np.asarray(normal(6, 9), np.float64)
    for i, layer in enumerate(network.layers):
        x = x if i == 0 else np.maximum(x, 0)
        x = x @ np.asarray(layer.weight, np.float64) + np.asarray(layer.bias, np.float64)
    assert x.min() < 0  # no ReLU at the end
    np.testing.assert_allclose(network(normal(6, 9)), x, rtol=1e-5, atol=1e-6)


def test_inputs_of_one_shape_are_concatenated(network: MLP):
    state, subgoal, action = normal(6, 3), normal(6, 4, seed=1), normal(6, 2, seed=2)
    together = jnp.concatenate([state, subgoal, action], axis=-1)
    np.testing.assert_allclose(network(state, subgoal, action), network(together), rtol=1e-6)


def test_broadcast_inputs_equal_their_concatenation(network: MLP):
    """A state (B, 1, S) beside ten subgoals (B, 10, S), and an action for each of the ten."""
    state, subgoal, action = normal(6, 1, 3), normal(6, 10, 4, seed=1), normal(1, 10, 2, seed=2)
    tiled = [jnp.tile(state, (1, 10, 1)), subgoal, jnp.tile(action, (6, 1, 1))]
    result = network(state, subgoal, action)
    assert result.shape == (6, 10, 5)
    # Summing three products instead of one long one may round a hidden bfloat16 differently.
    tolerance = 1e-5 if network.layers[0].precision == "f32" else 2e-2
    np.testing.assert_allclose(result, network(*tiled), rtol=tolerance, atol=tolerance)


def test_gradients_of_broadcast_inputs_equal_those_of_their_concatenation():
    network = network_of("f32")
    state, subgoal = normal(6, 1, 5), normal(6, 10, 4, seed=1)

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(arguments):
        network, state, subgoal = arguments
        return (network(state, subgoal) ** 2).sum()

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient_of_tiled(arguments):
        network, state, subgoal = arguments
        return (network(jnp.tile(state, (1, 10, 1)), subgoal) ** 2).sum()

    ours = jax.tree.leaves(gradient((network, state, subgoal)))
    tiled = jax.tree.leaves(gradient_of_tiled((network, state, subgoal)))
    for a, b in zip(ours, tiled, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * float(abs(b).max()))


def test_first_layer_multiplies_each_input_by_its_own_rows():
    layer = Linear(5, 4, "f32", key=jax.random.key(0))
    first, second = normal(6, 2), normal(6, 3, seed=1)
    parts = layer.product(first, 0) + layer.product(second, 2) + layer.bias
    np.testing.assert_allclose(
        parts, layer(jnp.concatenate([first, second], axis=-1)), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("shape", [(16, 40), (4, 10, 40)])
def test_bf16_product_sums_rounded_factors_in_float32(shape):
    x, weight, gradient = normal(*shape), normal(40, 24, seed=1), normal(*shape[:-1], 24, seed=2)
    result, transpose = jax.vjp(bf16_product, x, weight)
    to_x, to_weight = transpose(gradient)
    assert {result.dtype, to_x.dtype, to_weight.dtype} == {jnp.dtype(jnp.float32)}
    rows = (-1, shape[-1])
    expected_to_weight = rounded(x).reshape(rows).T @ rounded(gradient).reshape(-1, 24)
    for ours, expected in [
        (result, rounded(x) @ rounded(weight)),
        (to_x, rounded(gradient) @ rounded(weight).T),
        (to_weight, expected_to_weight),
    ]:
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4)


def test_bf16_product_differs_from_float32_by_the_rounding_only():
    x, weight = normal(64, 256), normal(256, 32, seed=1)
    error = np.linalg.norm(bf16_product(x, weight) - x @ weight) / np.linalg.norm(x @ weight)
    # Each factor is off by at most 2^-9 of itself, about 2^-10 as root mean square.
    assert 2.0**-12 < error < 2.0**-8


def test_arrays_and_outputs_are_float32(network: MLP):
    assert network(normal(6, 9)).dtype == jnp.float32
    assert {x.dtype for x in jax.tree.leaves(network)} == {jnp.dtype(jnp.float32)}


def test_unknown_precision_is_refused():
    with pytest.raises(TypeCheckError):
        MLP(3, (4,), 2, "f16", key=jax.random.key(0))
