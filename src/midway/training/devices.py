"""Several devices: lanes of the replay and rows of a batch split over them, networks on each.

A program is written for all rows and the compiler divides it, so a run has the same draws and, up
to rounding, the same numbers on any number of devices. On one device nothing here does anything.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ParamSpec, TypeVar

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from midway.errors import ConfigurationError

Tree = TypeVar("Tree", bound=PyTree)
Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")

AXIS = "devices"
SPLIT = PartitionSpec(AXIS)
"""The first axis in equal blocks, one on each device."""


@dataclass(frozen=True)
class Devices:
    """The devices of a run.

    Attributes:
        mesh: The devices in a row; None where there is only one, which JAX then uses by itself.
    """

    mesh: Mesh | None = None

    @staticmethod
    def first(number: int) -> "Devices":
        """Return the first ``number`` devices of the machine.

        Raises:
            ConfigurationError: There are fewer.
        """
        if number == 1:
            return Devices()
        found = jax.devices()
        if number > len(found):
            raise ConfigurationError(
                f"devices {number}: this machine has {len(found)} ({found[0].platform}); "
                "a run continues on fewer with --devices"
            )
        return Devices(jax.make_mesh((number,), (AXIS,), (AxisType.Auto,), devices=found[:number]))

    def copied(self, tree: Tree) -> Tree:
        """Return the arrays as they are, whole on every device."""
        return self._put(tree, PartitionSpec())

    def split(self, tree: Tree) -> Tree:
        """Return the arrays with their first axis split over the devices."""
        return self._put(tree, SPLIT)

    def copied_inside(self, tree: Tree) -> Tree:
        """Tell the compiler, inside a compiled function, to have the arrays on every device."""
        return self._inside(tree, PartitionSpec())

    def split_inside(self, tree: Tree) -> Tree:
        """Tell the compiler, inside a compiled function, to split the first axis of the arrays."""
        return self._inside(tree, SPLIT)

    def _inside(self, tree: Tree, spec: PartitionSpec) -> Tree:
        if self.mesh is None:
            return tree
        told: Tree = jax.lax.with_sharding_constraint(tree, NamedSharding(self.mesh, spec))
        return told

    def allocate(self, create: Callable[[], Tree]) -> Tree:
        """Return the new arrays of ``create``, split; no device ever holds them whole."""
        if self.mesh is None:
            return create()
        new: Tree = jax.jit(create, out_shardings=NamedSharding(self.mesh, SPLIT))()
        return new

    def compile(
        self, function: Callable[Inputs, Result], donate_argnums: tuple[int, ...] = ()
    ) -> Callable[Inputs, Result]:
        """Return the compiled function, whose results are whole on every device."""
        if self.mesh is None:
            return jax.jit(function, donate_argnums=donate_argnums)
        whole = NamedSharding(self.mesh, PartitionSpec())
        return jax.jit(function, donate_argnums=donate_argnums, out_shardings=whole)

    def _put(self, tree: Tree, spec: PartitionSpec) -> Tree:
        if self.mesh is None:
            return tree
        placed: Tree = jax.device_put(tree, NamedSharding(self.mesh, spec))
        return placed


def compile_by_lane(
    function: Callable[Inputs, Result], donated: tuple[int, ...] = (0,)
) -> Callable[Inputs, Result]:
    """Compile a function of a tree ``(K, ...)`` and of values ``(K, ...)`` that keeps lanes apart.

    The tree is donated, unless told otherwise. Where it is split over devices, each device does its
    own lanes, without a word to the others.
    """
    on_one_device = jax.jit(function, donate_argnums=donated)

    @cache
    def on(mesh: Mesh) -> Callable[Inputs, Result]:
        by_device = jax.shard_map(function, mesh=mesh, in_specs=SPLIT, out_specs=SPLIT)
        return jax.jit(by_device, donate_argnums=donated)

    def run(*inputs: Inputs.args, **options: Inputs.kwargs) -> Result:
        sharding = jax.tree.leaves(inputs[0])[0].sharding
        compiled = on(sharding.mesh) if isinstance(sharding, NamedSharding) else on_one_device
        return compiled(*inputs, **options)

    return run
