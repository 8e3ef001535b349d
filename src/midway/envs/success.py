"""When a goal counts as reached in an environment that is not midway's: rules as values.

A rule is a `GoalTask`: frozen, hashable, storable as JSON, and callable on NumPy arrays and inside
compiled steps. Which rule an environment gets is decided in ``deciding.py``.
"""

import atexit
import functools
import importlib
import json
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from midway.envs.sources import Source, import_module
from midway.errors import ConfigurationError
from midway.types import (
    ArrayLike,
    DistanceTask,
    Function,
    JsonObject,
    NumPyArray,
    Options,
    OwnEnv,
)

Array: TypeAlias = NumPyArray
How: TypeAlias = Literal["compiled", "batched", "pairs"]
"""How a rule is asked: inside the compiled step, once for a batch, or once for each pair."""

SLOW = "asked pair by pair, which is slow"


@dataclass(frozen=True)
class DistanceRule(DistanceTask):
    """Reached where the Euclidean distance between the goals is below a threshold.

    Attributes:
        because: Where the threshold comes from.
    """

    because: str = ""

    @property
    def description(self) -> str:
        """The rule as one line for the user."""
        return f"{super().description} ({self.because})"

    def to_json(self) -> JsonObject:
        """Return what a run folder stores."""
        groups = [list(group) for group in self.groups]
        values = {"groups": groups, "threshold": self.threshold, "because": self.because}
        return {"rule": "distance", **values}


class HostRule:
    """What rules share that are asked on the host, from within compiled steps too."""

    @property
    def how(self) -> How:
        """How the rule is asked."""
        raise NotImplementedError

    def reached(self, achieved: Array, desired: Array) -> Array:
        """Return whether each goal ``(B, goal_dim)`` is reached ``(B,)``."""
        raise NotImplementedError

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return the Euclidean distance between the goals ``(B,)``, in their own unit."""
        return ((achieved - desired) ** 2).sum(-1) ** 0.5

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Return reward ``(B,)``, always -1, and terminated ``(B,)``."""
        if isinstance(achieved, np.ndarray):
            reached: ArrayLike = self._host(achieved, np.asarray(desired))
        else:
            reached = self._compiled(achieved, desired)
        return (0 * reached - 1).astype("float32"), reached

    def _compiled(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return what is reached of JAX arrays: asked once for the batch, on the host."""
        import jax

        shape = jax.ShapeDtypeStruct(achieved.shape[:-1], np.bool_)  # type: ignore[no-untyped-call]
        return jax.pure_callback(self._host, shape, achieved, desired, vmap_method="broadcast_all")

    def _host(self, achieved: ArrayLike, desired: ArrayLike) -> Array:
        achieved, desired = np.asarray(achieved), np.asarray(desired)
        flat = (-1, achieved.shape[-1])
        reached = self.reached(achieved.reshape(flat), desired.reshape(flat))
        return np.asarray(reached, np.bool_).reshape(achieved.shape[:-1])


@dataclass(frozen=True)
class AskedRule(HostRule):
    """Reached where a method of the environment says so.

    Attributes:
        source: What makes the environment that is asked.
        method: ``compute_terminated``, ``compute_reward`` or ``_is_success``.
        above: Reached where the answer is above this; ``None`` where the answer is yes or no.
        batched: Whether it answers for a batch as for the pairs of it.
        goal_shape: Shape of a goal as the environment knows it.
    """

    source: Source
    method: str
    above: float | None
    batched: bool
    goal_shape: tuple[int, ...]

    @property
    def how(self) -> How:
        """How the environment is asked."""
        return "batched" if self.batched else "pairs"

    @property
    def description(self) -> str:
        """The rule as one line for the user."""
        above = "" if self.above is None else f" above {self.above:.6g}"
        slow = "" if self.batched else f"; {SLOW}"
        return f"where the environment's {self.method} is {above.strip() or 'true'}{slow}"

    def reached(self, achieved: Array, desired: Array) -> Array:
        """Return whether each goal ``(B, goal_dim)`` is reached ``(B,)``."""
        return self.answers(judge(self.source), achieved, desired)

    @property
    def threshold(self) -> float:
        """Reached where the answer, as a number, is above this."""
        return 0.5 if self.above is None else self.above

    def answers(self, env: OwnEnv, achieved: Array, desired: Array) -> Array:
        """Return whether an environment says that each goal is reached ``(B,)``."""
        reached: Array = self.values(env, achieved, desired) > self.threshold
        return reached

    def values(self, env: OwnEnv, achieved: Array, desired: Array) -> Array:
        """Return what an environment answers to each pair ``(B,)``, as float64."""
        shape = (len(achieved), *self.goal_shape)
        pairs = achieved.reshape(shape), desired.reshape(shape)
        return ask(env, self.method, *pairs, self.batched)

    def to_json(self) -> JsonObject:
        """Return what a run folder stores.

        Raises:
            ConfigurationError: No other process could make the environment.
        """
        return {
            "rule": "asked",
            "source": self.source.to_json(),
            "method": self.method,
            "above": self.above,
            "batched": self.batched,
            "goal_shape": list(self.goal_shape),
        }


@dataclass(frozen=True)
class FunctionRule(HostRule):
    """Reached where a function of the user says so.

    Attributes:
        reference: ``module:function``, which takes achieved and desired goals.
        asked: How it is asked.
        function: The function itself where no other process can find it by its reference.
    """

    reference: str
    asked: How
    function: Function | None = None

    @property
    def how(self) -> How:
        """How the function is asked."""
        return self.asked

    @property
    def description(self) -> str:
        """The rule as one line for the user."""
        how = {"compiled": "compiled", "batched": "asked in batches", "pairs": SLOW}[self.asked]
        return f"where {self.reference} is true ({how})"

    def reached(self, achieved: Array, desired: Array) -> Array:
        """Return whether each goal ``(B, goal_dim)`` is reached ``(B,)``."""
        function = self.function or function_of(self.reference)
        if self.asked != "pairs":
            return np.asarray(function(achieved, desired), np.bool_)
        pairs = zip(achieved, desired, strict=True)
        return np.array([bool(function(*pair)) for pair in pairs], np.bool_)

    def _compiled(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        if self.asked != "compiled":
            return super()._compiled(achieved, desired)
        function = self.function or function_of(self.reference)
        return function(achieved, desired).astype("bool")

    def to_json(self) -> JsonObject:
        """Return what a run folder stores.

        Raises:
            ConfigurationError: No other process could find the function.
        """
        if self.function is not None:
            raise ConfigurationError(
                f"success_function {self.reference} cannot be stored in a run folder: put it into "
                "a module as a function with a name"
            )
        return {"rule": "function", "reference": self.reference, "asked": self.asked}


Rule: TypeAlias = DistanceRule | AskedRule | FunctionRule


def from_json(stored: Options) -> Rule:
    """Return the rule that ``to_json`` was taken from.

    Raises:
        ConfigurationError: It is none.
    """
    values = {name: value for name, value in stored.items() if name != "rule"}
    try:
        if stored["rule"] == "distance":
            groups = tuple(tuple(group) for group in values.pop("groups"))
            return DistanceRule(groups=groups, **values)
        if stored["rule"] == "asked":
            source, shape = Source.from_json(values.pop("source")), values.pop("goal_shape")
            return AskedRule(source=source, goal_shape=tuple(shape), **values)
        if stored["rule"] == "function":
            return FunctionRule(**values)
    except (KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"success rule {json.dumps(dict(stored))}: {error}") from error
    raise ConfigurationError(
        f"success rule {stored['rule']!r}: must be distance, asked or function"
    )


@functools.lru_cache(maxsize=8)
def judge(source: Source) -> OwnEnv:
    """Return an environment that is only asked about goals, one for each process."""
    env = source.make()
    env.reset(seed=1)
    return env


# While Python still runs: simulators that are left to its end complain.
atexit.register(judge.cache_clear)


def method_of(env: OwnEnv, name: str) -> Function | None:
    """Return a method of an environment, of its outermost wrapper that has one."""
    for owner in (env, env.unwrapped):
        method = getattr(owner, name, None)
        if callable(method):
            return method  # type: ignore[no-any-return]
    return None


def ask(env: OwnEnv, name: str, achieved: Array, desired: Array, batched: bool) -> Array:
    """Return the answers ``(B,)`` of a method to pairs of goals ``(B, ...)``, as float64."""
    method: Function | None = method_of(env, name)
    # Public methods of the goal API are given an info, which hindsight goals do not have.
    extra: tuple[object, ...] = () if name.startswith("_") else ({},)
    if batched:
        return np.asarray(method(achieved, desired, *extra), np.float64).reshape(len(achieved))
    pairs = zip(achieved, desired, strict=True)
    return np.array([np.asarray(method(*pair, *extra)).item() for pair in pairs], np.float64)


def function_of(reference: str) -> Function:
    """Return the function that ``module:function`` names.

    Raises:
        ConfigurationError: There is none.
    """
    module, colon, name = reference.partition(":")
    if not colon or not name:
        raise ConfigurationError(f"success_function {reference!r}: must be module:function")
    function = getattr(import_module(module), name, None)
    if not callable(function):
        raise ConfigurationError(f"success_function {reference!r}: {module} has no such function")
    return function  # type: ignore[no-any-return]


def reference_of(function: Function) -> tuple[str, Function | None]:
    """Return how a function is stored, and the function itself where it cannot be."""
    name = getattr(function, "__qualname__", type(function).__name__)
    module = getattr(function, "__module__", "?")
    reference = f"{module}:{name}"
    if module == "__main__" or "." in name or "<" in name:
        return reference, function
    found = getattr(importlib.import_module(module), name, None)
    return reference, None if found is function else function
