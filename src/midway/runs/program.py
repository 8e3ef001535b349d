"""A policy as a short list of operations on arrays, for programs that have no JAX.

The policy is traced once for a batch of any size. What depends on the weights alone is computed
then; what is left are a few kinds of operation, which NumPy and ONNX have too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from midway.errors import ConfigurationError
from midway.types import Function, NumPyArray

BATCH = "batch"
"""A side of a shape that is the size of the batch."""

TRACED = 99_991
"""Size of the batch while a policy is traced: a prime number that no layer is as wide as."""

Shape: TypeAlias = tuple[int | str, ...]
"""Numbers, and ``BATCH``."""

ELEMENTWISE = {
    "add", "sub", "mul", "div", "max", "min", "neg", "abs", "exp", "log", "tanh", "sqrt", "rsqrt",
    "logistic", "pow", "square", "lt", "le", "gt", "ge", "eq", "and", "or", "not",
}  # fmt: skip
"""Primitives of JAX that need nothing but their inputs."""

SAME = {"copy", "copy_p", "stop_gradient"}
"""Primitives that return their input."""

CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
"""Parameters of primitives that call another program once."""

REPEATED = {"scan", "while", "cond"}
"""Primitives that call another program, but not once."""


Detail: TypeAlias = Any
"""What an operation needs besides arrays, by its kind."""


@dataclass(frozen=True)
class Operation:
    """One array from others.

    Attributes:
        kind: A name of ``ELEMENTWISE``, or ``matmul``, ``concatenate``, ``take``, ``slice``,
            ``reshape``, ``broadcast``, ``sum``, ``where``, ``clip``, ``power`` or ``float``.
        inputs: Names of arrays, or constants.
        output: Name of the result.
        detail: Axis, axes, shape, bounds of a slice along an axis, or exponent.
    """

    kind: str
    inputs: tuple["str | NumPyArray", ...]
    output: str
    detail: Detail = None


@dataclass
class Program:
    """Operations in their order.

    Attributes:
        inputs: Names of the inputs ``(B, n)``, float32.
        sizes: Their sizes n.
        operations: What is computed.
        output: Name of the result ``(B, m)``.
    """

    inputs: tuple[str, ...]
    sizes: tuple[int, ...]
    operations: list[Operation] = field(default_factory=list)
    output: str = ""


Equation: TypeAlias = Any
"""One of a jaxpr; JAX types no shapes of its variables."""

Value: TypeAlias = Any
"""The name of an array that depends on the inputs, or a constant of JAX or NumPy."""

Parts: TypeAlias = tuple[str, list[Value], Detail]
"""Kind, inputs and detail of an operation."""


def trace(function: Function, inputs: Sequence[str], sizes: Sequence[int]) -> Program:
    """Return a function of arrays ``(B, n)`` as a program.

    Raises:
        ConfigurationError: It does something that has no place in a program.
    """
    shapes = [jax.ShapeDtypeStruct((TRACED, size), np.float32) for size in sizes]
    closed = jax.make_jaxpr(function)(*shapes)
    program = Program(tuple(inputs), tuple(sizes))
    (output,) = _Tracer(program).run(closed, list(inputs))
    program.output = output
    return _without_unused(program)


class _Tracer:
    """Appends the operations of a program of JAX to one of ours."""

    def __init__(self, program: Program) -> None:
        self._program = program

    def run(self, closed: ClosedJaxpr, arguments: list[Value]) -> list[Value]:
        """Return the values of the outputs for those of the inputs."""
        jaxpr: Jaxpr = closed.jaxpr
        known: dict[object, Value] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
        known |= dict(zip(jaxpr.invars, arguments, strict=True))

        def value(atom: Value) -> Value:
            return atom.val if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            inputs = [value(atom) for atom in equation.invars]
            known |= zip(equation.outvars, self._apply(equation, inputs), strict=True)
        return [value(atom) for atom in jaxpr.outvars]

    def _apply(self, equation: Equation, inputs: list[Value]) -> list[Value]:
        """Return the values of an equation's outputs."""
        name, params = equation.primitive.name, equation.params
        called = [params[key] for key in CALLS if key in params]
        if called and name not in REPEATED:
            inner = called[0]
            closed = inner if hasattr(inner, "consts") else ClosedJaxpr(inner, ())
            return self.run(closed, inputs)
        shapes = [_shape(variable.aval.shape) for variable in equation.outvars]
        constant = not any(isinstance(x, str) for x in inputs)
        if constant and not any(BATCH in shape for shape in shapes):
            found = equation.primitive.bind(*inputs, **params)
            return list(found) if equation.primitive.multiple_results else [found]
        if name in SAME:
            return inputs
        return [self._add(*parts) for parts in _operations(equation, inputs, shapes)]

    def _add(self, kind: str, inputs: Sequence[Value], detail: Detail = None) -> str:
        """Append an operation; return the name of its result."""
        output = f"x{len(self._program.operations)}"
        given = tuple(x if isinstance(x, str) else _constant(x) for x in inputs)
        self._program.operations.append(Operation(kind, given, output, detail))
        return output


def _operations(equation: Equation, inputs: list[Value], shapes: list[Shape]) -> list[Parts]:
    """Return the operation for each output of an equation.

    Raises:
        ConfigurationError: There is none for this primitive, or for its parameters.
    """
    name, params = equation.primitive.name, equation.params
    if name in ELEMENTWISE:
        return [(name, inputs, None)]
    if name == "split":
        ends = np.cumsum(params["sizes"]).tolist()
        cuts = zip([0, *ends], ends, strict=False)
        return [("slice", inputs, (params["axis"], *cut)) for cut in cuts]
    found = OTHERS[name](equation, inputs, shapes[0]) if name in OTHERS else None
    if found is None:
        raise ConfigurationError(f"its policy computes {name!r}, which cannot be exported")
    return [found]


def _product(equation: Equation, inputs: list[Value], shape: Shape) -> Parts | None:
    """Return a product of rows ``(..., I)`` and a matrix ``(I, O)``; None for any other."""
    (left, right), batched = equation.params["dimension_numbers"]
    rank, sides = (len(variable.aval.shape) for variable in equation.invars)
    rows = (tuple(left), tuple(right), sides) == ((rank - 1,), (0,), 2) and not any(batched)
    return ("matmul", inputs, None) if rows else None


def _take(equation: Equation, inputs: list[Value], shape: Shape) -> Parts | None:
    """Return a choice of known entries along one axis; None for any other gather."""
    numbers, sides = equation.params["dimension_numbers"], equation.invars[0].aval.shape
    array, entries = inputs
    axes = numbers.start_index_map
    others = tuple(axis for axis in range(len(sides)) if axis not in axes)
    known = not isinstance(entries, str) and np.ndim(entries) == 2 and len(axes) == 1
    whole = all(equation.params["slice_sizes"][axis] == sides[axis] for axis in others)
    plain = numbers.collapsed_slice_dims == axes and numbers.offset_dims == others
    if not (known and whole and plain) or numbers.operand_batching_dims:
        return None
    return "take", [array, np.asarray(entries)[:, 0]], axes[0]


def _spread(equation: Equation, inputs: list[Value], shape: Shape) -> Parts:
    """Return a broadcast: the shape with a side of 1 for each new axis, then the whole one."""
    sides = _shape(equation.invars[0].aval.shape)
    known = dict(zip(equation.params["broadcast_dimensions"], sides, strict=True))
    return "broadcast", inputs[:1], (tuple(known.get(a, 1) for a in range(len(shape))), shape)


def _cut(equation: Equation, inputs: list[Value], shape: Shape) -> Parts | None:
    """Return a slice along one axis; None for any other."""
    sides, params = equation.invars[0].aval.shape, equation.params
    bounds = list(zip(params["start_indices"], params["limit_indices"], sides, strict=True))
    cut = [axis for axis, (start, end, side) in enumerate(bounds) if (start, end) != (0, side)]
    if len(cut) != 1 or (params["strides"] and set(params["strides"]) != {1}):
        return None
    start, end, _ = bounds[cut[0]]
    return "slice", inputs, (cut[0], int(start), int(end))


def _reshape(equation: Equation, inputs: list[Value], shape: Shape) -> Parts:
    return "reshape", inputs[:1], shape


OTHERS: dict[str, Callable[[Equation, list[Value], Shape], Parts | None]] = {
    "integer_pow": lambda equation, x, shape: ("power", x, equation.params["y"]),
    "convert_element_type": lambda equation, x, shape: ("float", x, None),
    "concatenate": lambda equation, x, shape: ("concatenate", x, equation.params["dimension"]),
    "select_n": lambda equation, x, shape: ("where", [x[0], *x[:0:-1]], None),
    "clamp": lambda equation, x, shape: ("clip", [x[1], x[0], x[2]], None),
    "reduce_sum": lambda equation, x, shape: ("sum", x, tuple(equation.params["axes"])),
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "dot_general": _product,
    "broadcast_in_dim": _spread,
    "gather": _take,
    "slice": _cut,
}
"""Primitives by name: what they are here, from the equation, its inputs and its output's shape."""


def _shape(shape: Sequence[int]) -> Shape:
    """Return a shape with the size of the batch by its name.

    Raises:
        ConfigurationError: A side is made of the batch and something else.
    """
    if any(side > TRACED and side % TRACED == 0 for side in shape):
        raise ConfigurationError("its policy mixes the rows of a batch, which cannot be exported")
    return tuple(BATCH if side == TRACED else int(side) for side in shape)


def _constant(value: Value) -> NumPyArray:
    array = np.asarray(value)
    return array if array.dtype in (np.bool_, np.int64, np.int32) else array.astype(np.float32)


def _without_unused(program: Program) -> Program:
    """Return the program without operations that its output does not need."""
    needed, kept = {program.output}, []
    for operation in reversed(program.operations):
        if operation.output in needed:
            needed |= {name for name in operation.inputs if isinstance(name, str)}
            kept.append(operation)
    program.operations = kept[::-1]
    return program
