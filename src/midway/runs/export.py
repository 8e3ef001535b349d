"""Policies for programs without JAX: what they compute, and a NumPy module of it."""

import importlib.util
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from midway import files
from midway.envs import own_spaces
from midway.envs.reading import GOAL_KEYS
from midway.errors import ConfigurationError
from midway.runs.policy import Policy
from midway.runs.program import BATCH, Operation, Program, Shape, trace
from midway.types import NumPyArray

Act: TypeAlias = Callable[[Mapping[str, NumPyArray]], NumPyArray]
"""From the environment's dictionary, its entries flat, to actions ``(B, A)``."""

ROUNDING = {"f32": 1e-4, "bf16": 0.05}
"""Largest allowed difference to the policy in JAX, where actions are in [-1, 1]: files compute in
float32, also what was rounded to bfloat16."""

CHECKED = 64
"""Observations that both are compared on."""


def program_of(policy: Policy) -> Program:
    """Return the deterministic policy from what the environment observes to its own actions.

    Raises:
        ConfigurationError: It reads images, remembers its episode, or computes what cannot be
            exported.
    """
    spec, agent = policy.spec, policy.agent
    if spec.is_image:
        raise ConfigurationError(f"export: {spec.name} is seen in images; only states are exported")
    if agent.memory:
        raise ConfigurationError(
            f"export: {policy.config.agent} remembers its episode; only policies that do not are "
            "exported"
        )
    foreign = policy.config.declaration().foreign
    appended = own_spaces.appends_goal(spec, foreign)
    low, high = own_spaces.bounds(spec, foreign)

    def act(
        observation: Float[Array, "B O"],
        achieved_goal: Float[Array, "B G"],
        desired_goal: Float[Array, "B G"],
    ) -> Float[Array, "B A"]:
        shown = [observation, achieved_goal] if appended else [observation]
        pair = jnp.concatenate(shown, axis=-1), desired_goal
        actions = agent.act(policy.state, *pair, jax.random.key(0), False)
        return jnp.asarray(low) + (jnp.clip(actions, -1, 1) + 1) / 2 * jnp.asarray(high - low)

    (goal,) = spec.goal_shape
    size = spec.observation_shape[0] - (goal if appended else 0)
    try:
        return trace(act, GOAL_KEYS, (size, goal, goal))
    except ConfigurationError as error:
        raise ConfigurationError(f"export: {policy.config.agent}: {error}") from error


def check(policy: Policy, act: Act) -> float:
    """Return the largest difference between an exported policy and itself, as part of its bounds.

    Raises:
        ConfigurationError: It is more than rounding.
    """
    spec = policy.spec
    foreign = policy.config.declaration().foreign
    low, high = own_spaces.bounds(spec, foreign)
    rng, program = np.random.default_rng(0), program_of(policy)
    middle, spread = spec.center or spec.origin, spec.spread or spec.unit
    sizes = dict(zip(program.inputs, program.sizes, strict=True))
    shown = {}
    for name, size in sizes.items():
        drawn = rng.normal(size=(CHECKED, size))
        if middle and name == "observation":
            drawn = np.asarray(middle)[:size] + drawn * np.broadcast_to(spread, len(middle))[:size]
        shown[name] = drawn.astype(np.float32)
    states = shown["observation"]
    if own_spaces.appends_goal(spec, foreign):
        states = np.concatenate([states, shown["achieved_goal"]], axis=1)
    expected = low + (policy(states, shown["desired_goal"]) + 1) / 2 * (high - low)
    off = float((np.abs(act(shown) - expected) / (high - low) * 2).max())
    precision = getattr(policy.config.hyperparameters, "precision", "f32")
    if not off <= ROUNDING.get(precision, ROUNDING["f32"]):
        raise ConfigurationError(f"export: actions of the file are off by {off:.2g}")
    return off


NUMPY = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "max": "np.maximum({}, {})",
    "min": "np.minimum({}, {})",
    "neg": "-{}",
    "abs": "np.abs({})",
    "exp": "np.exp({})",
    "log": "np.log({})",
    "tanh": "np.tanh({})",
    "sqrt": "np.sqrt({})",
    "rsqrt": "1 / np.sqrt({})",
    "logistic": "1 / (1 + np.exp(-{}))",
    "pow": "{} ** {}",
    "square": "{0} * {0}",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "gt": "{} > {}",
    "ge": "{} >= {}",
    "eq": "{} == {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "not": "~{}",
    "matmul": "{} @ {}",
    "where": "np.where({}, {}, {})",
    "clip": "np.clip({}, {}, {})",
    "float": "np.asarray({}, np.float32)",
    "power": "{0} ** {detail}",
    "sum": "{0}.sum({detail})",
    "take": "np.take({}, {}, {detail})",
    "reshape": "np.reshape({0}, {detail})",
}

MODULE = '''"""The policy of {name}, made by midway export: NumPy is all that it needs.

    from policy import act
    action = act(observation)

The observation is the environment's dictionary, its entries as flat vectors, or batches of them
(B, n); actions are within the bounds of the environment, (A,) or (B, A).
"""

from pathlib import Path

import numpy as np

WEIGHTS = dict(np.load(Path(__file__).with_suffix(".npz")))


def act(shown):
    """Return the deterministic action for {sizes}."""
    names = {inputs}
    arrays = [np.asarray(shown[name], np.float32) for name in names]
    single = arrays[-1].ndim == 1
    {arguments} = [np.atleast_2d(array) for array in arrays]
    batch = len({first})
    w = WEIGHTS
{body}
    return {output}[0] if single else {output}
'''


def write_numpy(policy: Policy, module: Path) -> Act:
    """Write a module with a function ``act``, and its weights beside it; return the function.

    Raises:
        ConfigurationError: As `program_of`.
        OSError: A file cannot be written.
    """
    program = program_of(policy)
    weights: dict[str, NumPyArray] = {}
    body = "\n".join(f"    {line}" for line in _lines(program, weights))
    sizes = [f"{name} ({size})" for name, size in zip(program.inputs, program.sizes, strict=True)]
    config = policy.config
    text = MODULE.format(
        name=f"{config.agent} on {config.env} after {policy.step} steps",
        sizes=", ".join(sizes),
        inputs=program.inputs,
        arguments=", ".join(program.inputs),
        first=program.inputs[0],
        body=body,
        output=program.output,
    )
    content = io.BytesIO()
    np.savez(content, **weights)  # type: ignore[arg-type]
    files.write(module.with_suffix(".npz"), content.getvalue())
    files.write(module, text.encode())
    return _act_of(module)


def _act_of(module: Path) -> Act:
    """Return the function ``act`` of a module that was written."""
    spec = importlib.util.spec_from_file_location("exported_policy", module)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    act: Act = loaded.act
    return act


def _lines(program: Program, weights: dict[str, NumPyArray]) -> Iterator[str]:
    """Yield a line of Python for each operation; its constants become weights."""
    for operation in program.operations:
        inputs = [_written(x, weights) for x in operation.inputs]
        yield f"{operation.output} = {_expression(operation, inputs)}"


def _written(value: str | NumPyArray, weights: dict[str, NumPyArray]) -> str:
    """Return a name or number; an array gets the name of a weight."""
    if isinstance(value, str):
        return value
    if value.ndim == 0:
        number = value.item()
        return f"np.float32({number!r})" if isinstance(number, float) else repr(number)
    name = f"w{len(weights)}"
    weights[name] = value
    return f'w["{name}"]'


def _expression(operation: Operation, inputs: list[str]) -> str:
    kind, detail = operation.kind, operation.detail
    if kind == "concatenate":
        return f"np.concatenate([{', '.join(inputs)}], {detail})"
    if kind == "slice":
        axis, start, end = detail
        return f"{inputs[0]}[{':, ' * axis}{start}:{end}]"
    if kind == "broadcast":
        spread, shape = (_sides(part, "batch") for part in detail)
        return f"np.broadcast_to(np.reshape({inputs[0]}, {spread}), {shape})"
    if kind == "reshape":
        detail = _sides(detail, "batch")
    return NUMPY[kind].format(*inputs, detail=detail)


def _sides(shape: Shape, batch: str) -> str:
    return f"({''.join(f'{batch if side == BATCH else side}, ' for side in shape)})"
