"""Networks of a user's own in place of multilayer perceptrons, by the name of their function."""

import importlib
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from midway.errors import ConfigurationError
from midway.networks.mlp import MLP, Precision
from midway.types import Function


@runtime_checkable
class Network(Protocol):
    """A module from some inputs, one beside the other, to an output."""

    def __call__(self, *inputs: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the output ``(*B, O)`` for inputs ``(*B_i, I_i)`` with broadcastable ``B_i``."""
        ...


class Custom(eqx.Module):
    """A network of a user's own, over the concatenation of the inputs."""

    module: Callable[[Float[Array, "*B I"]], Float[Array, "*B O"]]

    def __call__(self, *inputs: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the output ``(*B, O)`` for inputs ``(*B_i, I_i)`` with broadcastable ``B_i``."""
        leading = jnp.broadcast_shapes(*(x.shape[:-1] for x in inputs))
        whole = [jnp.broadcast_to(x, (*leading, x.shape[-1])) for x in inputs]
        return self.module(jnp.concatenate(whole, axis=-1))


def create(
    name: str,
    sizes: tuple[int, tuple[int, ...], int],
    precision: Precision,
    *,
    key: Key[Array, ""],
    layer_norm: bool = False,
) -> Network:
    """Return a network: an `MLP`, or what a function of the user's makes.

    Args:
        name: ``module:function``; nothing for an `MLP`. The function takes the numbers of inputs I
            and outputs O and ``key``, and returns an Equinox module from ``(*B, I)`` to
            ``(*B, O)``, float32, whose arrays are its weights.
        sizes: Inputs, hidden layers, outputs.
        precision: Of an `MLP`'s products.
        key: Key of the random start.
        layer_norm: Whether an `MLP` has it.

    Raises:
        ConfigurationError: There is no such function, or it makes something else.
    """
    if not name:
        return MLP(*sizes, precision, key=key, layer_norm=layer_norm)
    in_size, _, out_size = sizes
    found = _function(name)(in_size, out_size, key=key)
    if not callable(found):
        raise ConfigurationError(f"network {name}: gives {type(found).__name__}, not a module")
    network = Custom(found)
    for batch in ((3,), (3, 2)):
        x = jax.ShapeDtypeStruct((*batch, in_size), jnp.float32)
        try:
            y: Any = eqx.filter_eval_shape(network, x)
            shape, dtype = y.shape, y.dtype
        except Exception as error:  # whatever the code of others raises
            text = f"{type(error).__name__}: {''.join(str(error).splitlines()[:1])}"
            raise ConfigurationError(f"network {name}: on {x.shape}: {text}") from error
        if (shape, dtype) != ((*batch, out_size), jnp.float32):
            raise ConfigurationError(
                f"network {name}: makes {dtype} {shape} of {x.shape}: must be float32 "
                f"{(*batch, out_size)}"
            )
    return network


def _function(name: str) -> Function:
    module, _, attribute = name.partition(":")
    try:
        function: Any = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigurationError(f"network {name}: {error}") from error
    if not callable(function):
        raise ConfigurationError(f"network {name}: is a {type(function).__name__}, not a function")
    return function  # type: ignore[no-any-return]
