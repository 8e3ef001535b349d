"""Policies as ONNX models."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from midway import files
from midway.errors import needing
from midway.runs.export import Act, program_of
from midway.runs.policy import Policy
from midway.runs.program import BATCH, Operation, Program, Shape
from midway.types import NumPyArray

OPSET = 18

ONNX = {
    "add": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "div": "Div",
    "max": "Max",
    "min": "Min",
    "neg": "Neg",
    "abs": "Abs",
    "exp": "Exp",
    "log": "Log",
    "tanh": "Tanh",
    "sqrt": "Sqrt",
    "logistic": "Sigmoid",
    "pow": "Pow",
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
    "and": "And",
    "or": "Or",
    "not": "Not",
    "matmul": "MatMul",
    "where": "Where",
    "clip": "Clip",
}
"""Kinds whose inputs ONNX takes as they are."""

ALONG = {"concatenate": "Concat", "take": "Gather"}
"""Kinds with an axis."""

EXPONENTS = {"square": 2.0, "rsqrt": -0.5, "power": None}
"""Kinds that are powers; None where the operation says which."""


def write_onnx(policy: Policy, path: Path) -> Act:
    """Write an ONNX model with the inputs of the environment's dictionary and output ``action``.

    Returns:
        The model, run by the reference implementation of ONNX.

    Raises:
        ConfigurationError: As `program_of`, or ONNX is not installed.
        OSError: The file cannot be written.
    """
    with needing("onnx", "export --onnx"):
        import onnx
        from onnx.reference import ReferenceEvaluator
    program = program_of(policy)
    model = _Model(onnx.helper, program).build()
    onnx.checker.check_model(model)
    files.write(path, model.SerializeToString())
    evaluator = ReferenceEvaluator(model)

    def act(shown: Mapping[str, NumPyArray]) -> NumPyArray:
        found: NumPyArray = evaluator.run(None, dict(shown))[0]
        return found

    return act


class _Model:
    """An ONNX model in the making.

    Args:
        helper: ``onnx.helper``.
        program: What it computes.
    """

    def __init__(self, helper: Any, program: Program) -> None:
        self._helper = helper
        self._program = program
        self._nodes: list[Any] = []
        self._weights: list[Any] = []

    def build(self) -> Any:
        """Return the model."""
        helper, program = self._helper, self._program
        number = helper.np_dtype_to_tensor_dtype(np.dtype(np.float32))
        for operation in program.operations:
            self._translate(operation)
        self._nodes.append(helper.make_node("Identity", [program.output], ["action"]))
        inputs = [
            helper.make_tensor_value_info(name, number, [BATCH, size])
            for name, size in zip(program.inputs, program.sizes, strict=True)
        ]
        output = helper.make_tensor_value_info("action", number, [BATCH, None])
        graph = helper.make_graph(self._nodes, "policy", inputs, [output], self._weights)
        opset = helper.make_opsetid("", OPSET)
        return helper.make_model(graph, opset_imports=[opset], ir_version=10)

    def _translate(self, operation: Operation) -> None:
        """Add the nodes of an operation."""
        kind, detail, out = operation.kind, operation.detail, operation.output
        inputs = [x if isinstance(x, str) else self._weight(x) for x in operation.inputs]
        if kind in ONNX:
            self._node(ONNX[kind], inputs, out)
        elif kind in EXPONENTS:
            exponent = EXPONENTS[kind] or detail
            self._node("Pow", [*inputs, self._weight(np.float32(exponent))], out)
        elif kind == "float":
            self._node("Cast", inputs, out, to=1)
        elif kind in ALONG:
            self._node(ALONG[kind], inputs, out, axis=detail)
        elif kind == "sum":
            self._node("ReduceSum", [*inputs, self._whole(*detail)], out, keepdims=0)
        elif kind == "slice":
            axis, start, end = detail
            self._node("Slice", [*inputs, *map(self._whole, (start, end, axis))], out)
        elif kind == "reshape":
            self._node("Reshape", [*inputs, self._shape(detail)], out)
        else:
            spread, shape = detail
            reshaped = self._node("Reshape", [*inputs, self._shape(spread)])
            self._node("Expand", [reshaped, self._shape(shape)], out)

    def _node(self, kind: str, inputs: list[str], out: str = "", **attributes: int) -> str:
        """Add a node; return the name of its output."""
        out = out or f"n{len(self._nodes)}"
        self._nodes.append(self._helper.make_node(kind, inputs, [out], **attributes))
        return out

    def _weight(self, value: Any) -> str:
        """Return the name of a constant array."""
        from onnx import numpy_helper

        name = f"w{len(self._weights)}"
        self._weights.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def _whole(self, *numbers: int) -> str:
        return self._weight(np.array(numbers, np.int64))

    def _shape(self, shape: Shape) -> str:
        """Return the name of a shape, whose batch is that of the first input."""
        if BATCH not in shape:
            return self._whole(*(int(side) for side in shape))
        whole = self._node("Shape", [self._program.inputs[0]])
        batch = self._node("Slice", [whole, self._whole(0), self._whole(1)])
        parts = [batch if side == BATCH else self._whole(int(side)) for side in shape]
        return self._node("Concat", parts, axis=0)
