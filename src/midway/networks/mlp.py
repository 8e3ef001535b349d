"""Multilayer perceptrons, with matrix products in float32 or bfloat16."""

from pathlib import Path
from typing import Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, BFloat16, Float, Key

Precision: TypeAlias = Literal["f32", "bf16"]

PRECISIONS: tuple[Precision, ...] = get_args(Precision)

DTYPES = {"f32": jnp.float32, "bf16": jnp.bfloat16}
"""What the inputs of matrix products are rounded to."""


def fastest_precision() -> Precision:
    """Return ``bf16`` where the processor multiplies bfloat16 matrices itself, else ``f32``.

    On processors that is AVX512-BF16 or AMX, on other devices it is taken for granted.
    """
    if jax.default_backend() != "cpu":
        return "bf16"
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return "f32"
    return "bf16" if "avx512_bf16" in flags or "amx_bf16" in flags else "f32"


@jax.custom_vjp
def bf16_product(x: Float[Array, "*B I"], weight: Float[Array, "I O"]) -> Float[Array, "*B O"]:
    """Return x @ weight from inputs rounded to bfloat16, summed and returned in float32.

    Both products of the gradient are rounded in the same way; gradients come out as float32.
    """
    return _product_of_rounded(x.astype(jnp.bfloat16), weight.astype(jnp.bfloat16))


def _product_of_rounded(
    x: BFloat16[Array, "*B I"], weight: BFloat16[Array, "I O"]
) -> Float[Array, "*B O"]:
    return jax.lax.dot_general(
        x, weight, (((x.ndim - 1,), (0,)), ((), ())), preferred_element_type=jnp.float32
    )


def _product_forward(
    x: Float[Array, "*B I"], weight: Float[Array, "I O"]
) -> tuple[Float[Array, "*B O"], tuple[BFloat16[Array, "*B I"], BFloat16[Array, "I O"]]]:
    rounded = (x.astype(jnp.bfloat16), weight.astype(jnp.bfloat16))
    return _product_of_rounded(*rounded), rounded


def _product_backward(
    residuals: tuple[BFloat16[Array, "*B I"], BFloat16[Array, "I O"]],
    gradient: Float[Array, "*B O"],
) -> tuple[Float[Array, "*B I"], Float[Array, "I O"]]:
    x, weight = residuals
    gradient = gradient.astype(jnp.bfloat16)
    batch_axes = tuple(range(x.ndim - 1))
    to_x = jax.lax.dot_general(
        gradient, weight, (((x.ndim - 1,), (1,)), ((), ())), preferred_element_type=jnp.float32
    )
    to_weight = jax.lax.dot_general(
        x, gradient, ((batch_axes, batch_axes), ((), ())), preferred_element_type=jnp.float32
    )
    return to_x, to_weight


bf16_product.defvjp(_product_forward, _product_backward)


class Linear(eqx.Module):
    """An affine map ``(..., I) -> (..., O)``; start uniform in ±1/sqrt(I), as in the original."""

    weight: Float[Array, "I O"]
    bias: Float[Array, " O"]
    precision: Precision = eqx.field(static=True)

    def __init__(
        self, in_size: int, out_size: int, precision: Precision, *, key: Key[Array, ""]
    ) -> None:
        weight_key, bias_key = jax.random.split(key)
        bound = in_size**-0.5
        self.weight = jax.random.uniform(
            weight_key, (in_size, out_size), minval=-bound, maxval=bound
        )
        self.bias = jax.random.uniform(bias_key, (out_size,), minval=-bound, maxval=bound)
        self.precision = precision

    def product(self, x: Float[Array, "*B I"], start: int = 0) -> Float[Array, "*B O"]:
        """Return x times the weight's rows from ``start`` on, without the bias."""
        weight = self.weight[start : start + x.shape[-1]]
        return bf16_product(x, weight) if self.precision == "bf16" else x @ weight

    def __call__(self, x: Float[Array, "*B I"]) -> Float[Array, "*B O"]:
        """Return x @ weight + bias."""
        return self.product(x) + self.bias


def normalised(x: Float[Array, "*B H"]) -> Float[Array, "*B H"]:
    """Return x with mean 0 and variance 1 over the last axis (layer norm without parameters)."""
    centered = x - x.mean(-1, keepdims=True)
    return centered * jax.lax.rsqrt((centered**2).mean(-1, keepdims=True) + 1e-5)


class MLP(eqx.Module):
    """ReLU layers over the concatenation of the inputs (table 1: two hidden layers of 256).

    Inputs whose leading axes differ are broadcast against each other *after* the first product:
    a state beside ten subgoals, ``(B, 1, S)`` and ``(B, 10, S)``, is multiplied once, not ten
    times.
    """

    layers: tuple[Linear, ...]
    layer_norm: bool = eqx.field(static=True)

    def __init__(
        self,
        in_size: int,
        hidden: tuple[int, ...],
        out_size: int,
        precision: Precision,
        *,
        key: Key[Array, ""],
        layer_norm: bool = False,
    ) -> None:
        self.layer_norm = layer_norm
        sizes = (in_size, *hidden, out_size)
        keys = jax.random.split(key, len(sizes) - 1)
        self.layers = tuple(
            Linear(i, o, precision, key=k)
            for i, o, k in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )

    def __call__(self, *inputs: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the output ``(*B, O)`` for inputs ``(*B_i, I_i)`` with broadcastable ``B_i``."""
        x = self._first_layer(inputs)
        for layer in self.layers[1:]:
            x = layer(jax.nn.relu(normalised(x) if self.layer_norm else x))
        return x

    def _first_layer(self, inputs: tuple[Float[Array, "..."], ...]) -> Float[Array, "..."]:
        first = self.layers[0]
        if all(x.shape[:-1] == inputs[0].shape[:-1] for x in inputs):
            return first(jnp.concatenate(inputs, axis=-1))
        start, total = 0, first.bias
        for x in inputs:
            total = total + first.product(x, start)
            start += x.shape[-1]
        return total
