"""Where an environment that is not midway's comes from, and how as many as are wanted are made.

``Id`` and ``module:Id`` are Gymnasium's own names; ``module:callable`` is a class or function that
returns an environment. In Python such a callable, or an environment that ``gymnasium.make``
returned, serves too.
"""

import contextlib
import functools
import importlib
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import gymnasium

from midway.envs import packages
from midway.errors import ConfigurationError
from midway.types import (
    Function,
    JsonObject,
    Options,
    OwnEnv,
)

Env: TypeAlias = OwnEnv
"""A Gymnasium environment of any kind of observation and action."""


class UnknownEnvironmentError(ConfigurationError):
    """There is no environment of this name."""


@dataclass(frozen=True)
class Source:
    """What makes an environment; the same value makes the same environment in another process.

    Attributes:
        reference: ``Id``, ``module:Id`` or ``module:callable``.
        kwargs: Keyword arguments of the environment, as JSON.
        imports: Modules to import first, which register environments.
        factory: What makes the environment where no other process can find it by its reference,
            such as a lambda.
    """

    reference: str
    kwargs: str = "{}"
    imports: tuple[str, ...] = ()
    factory: Function | None = None

    def make(self, max_episode_steps: int | None = None, render_mode: str | None = None) -> Env:
        """Return one new environment.

        Args:
            max_episode_steps: Limit in place of the registered one.
            render_mode: Gymnasium's, such as ``rgb_array``.

        Raises:
            ConfigurationError: It cannot be found or made.
        """
        for module in self.imports:
            import_module(module)
        given = json.loads(self.kwargs) | ({"render_mode": render_mode} if render_mode else {})
        make = self.factory or _callable(self.reference)
        if make is None:
            _register(self.reference)
            limit = {"max_episode_steps": max_episode_steps} if max_episode_steps else {}
            make = functools.partial(
                gymnasium.make, self.reference, disable_env_checker=True, **limit
            )
        packages.fit_to_mujoco()
        with printing_to_stderr(), _one_line(self.reference):
            env = make(**given)
        if not isinstance(env, gymnasium.Env):
            raise ConfigurationError(
                f"{self.reference} gives {type(env).__name__}: must be a gymnasium.Env"
            )
        return packages.adapted(self.reference.rpartition(":")[2], env)

    def to_json(self) -> JsonObject:
        """Return what a run folder stores.

        Raises:
            ConfigurationError: No other process could make this environment.
        """
        if self.factory is not None:
            raise ConfigurationError(
                f"environment {self.reference} cannot be stored in a run folder: put what makes it "
                "into a module as a class or function with a name, or register it with Gymnasium"
            )
        kwargs = json.loads(self.kwargs)
        return {"reference": self.reference, "kwargs": kwargs, "imports": list(self.imports)}

    @staticmethod
    def from_json(stored: Options) -> "Source":
        """Return the source that ``to_json`` was taken from."""
        kwargs = json.dumps(stored["kwargs"], sort_keys=True)
        return Source(stored["reference"], kwargs, tuple(stored["imports"]))


def source(
    env: "str | Source | Function | Env",
    kwargs: Options | None = None,
    imports: tuple[str, ...] = (),
) -> Source:
    """Return where an environment comes from.

    Args:
        env: A name, a callable that makes environments, or what ``gymnasium.make`` returned.
        kwargs: Keyword arguments of the environment.
        imports: Modules to import first.

    Raises:
        ConfigurationError: There is no environment of this name, or none can be made from it.
    """
    if isinstance(env, Source):
        return env
    if isinstance(env, gymnasium.Env):
        return _source_of_object(env, imports)
    stored = _as_json(kwargs or {})
    if isinstance(env, str):
        for module in imports:
            import_module(module)
        if _callable(env) is None:
            _register(env)
        return Source(env, stored, imports)
    if not callable(env):
        raise ConfigurationError(
            f"environment {env!r}: must be a name, a class, a function that makes one, or an "
            "environment of gymnasium.make"
        )
    reference = _reference(env)
    return Source(reference, stored, imports, None if _finds(reference, env) else env)


def import_module(name: str) -> Any:
    """Import a module, also from the folder that midway was started in.

    Raises:
        ConfigurationError: There is none of this name, or it fails.
    """
    with printing_to_stderr():
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise ConfigurationError(f"module {name} cannot be imported: {error}") from error
        except Exception as error:
            raise ConfigurationError(f"module {name} cannot be imported: {_line(error)}") from error
        if os.getcwd() in sys.path:
            raise ConfigurationError(
                f"there is no module {name}: install it, or start midway in the folder that holds "
                "it"
            )
        sys.path.append(os.getcwd())
        return import_module(name)


@contextlib.contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Send what simulators print on standard output to standard error, where ``--json`` needs it.

    Simulators print from C (PyBullet its build time), so that the descriptor itself is changed.
    """
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:  # there is no standard output
        yield
        return
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _register(name: str) -> None:
    """Import what registers a Gymnasium id.

    Raises:
        UnknownEnvironmentError: There is no environment of this name.
    """
    module, _, gym_id = name.rpartition(":")
    if module:
        import_module(module)
    elif gym_id not in gymnasium.registry:
        packages.load_for(gym_id, import_module)
    try:
        gymnasium.spec(gym_id)
    except gymnasium.error.Error as error:
        hint = packages.hint(gym_id)
        raise UnknownEnvironmentError(
            f"unknown environment {name!r}: {hint or ' '.join(str(error).split())}"
        ) from error


def _callable(reference: str) -> Function | None:
    """Return the callable that ``module:name`` names; nothing where this is no such name."""
    module, colon, name = reference.partition(":")
    if not colon or not re.fullmatch(r"[A-Za-z_][\w.]*", name):
        return None
    value: Any = import_module(module)
    for part in name.split("."):
        value = getattr(value, part, None)
    return value if callable(value) else None


def _reference(function: Function) -> str:
    if isinstance(function, functools.partial):
        return f"{_reference(function.func)}(...)"
    name = getattr(function, "__qualname__", type(function).__name__)
    return f"{getattr(function, '__module__', '?')}:{name}"


def _finds(reference: str, function: Function) -> bool:
    """Return whether another process would find this very callable by its reference."""
    if reference.startswith("__main__:") or "<" in reference:
        return False
    try:
        return _callable(reference) is function
    except ConfigurationError:
        return False


def _source_of_object(env: Env, imports: tuple[str, ...]) -> Source:
    """Return the source of what ``gymnasium.make`` returned."""
    spec = env.spec
    if spec is None or spec.additional_wrappers:
        raise ConfigurationError(
            f"environment {type(env).__name__} is one object, and several are needed: give its "
            "class, or a function that makes it"
        )
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    registered = gymnasium.registry.get(spec.id)
    usual = registered.kwargs if registered is not None else {}
    return Source(
        spec.id, _as_json({k: v for k, v in kwargs.items() if usual.get(k) is not v}), imports
    )


def _as_json(kwargs: Options) -> str:
    try:
        return json.dumps(dict(kwargs), sort_keys=True)
    except TypeError as error:
        raise ConfigurationError(
            f"arguments {dict(kwargs)!r} of the environment: must be numbers, text and lists; for "
            "others give a function that makes the environment"
        ) from error


@contextlib.contextmanager
def _one_line(reference: str) -> Iterator[None]:
    """Turn whatever an environment raises while it is made into one line."""
    try:
        yield
    except ConfigurationError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"environment {reference} cannot be made: {_line(error)}"
        ) from error


def _line(error: Exception) -> str:
    """Return an error as one line, with the place where it was raised."""
    text = " ".join(str(error).split()) or "no reason given"
    if isinstance(error, gymnasium.error.Error):
        return text
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} ({os.path.basename(place.filename)}:{place.lineno})"
