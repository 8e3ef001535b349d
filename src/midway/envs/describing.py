"""What midway must know of an environment that is not its own, found out once.

Such an environment observes a dictionary of ``observation``, ``achieved_goal`` and
``desired_goal``. Its rule of success is found by ``deciding.py``, and stepped it is by
``foreign.py``.
"""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from midway.envs import deciding, success
from midway.envs.probes import Probes, probe
from midway.envs.reading import AnySpace, readings
from midway.envs.sources import Source, source
from midway.envs.success import Rule, judge, reference_of
from midway.envs.vector import Array
from midway.errors import ConfigurationError
from midway.plain import check_kinds
from midway.types import (
    DistanceTask,
    EnvSpec,
    Function,
    JsonObject,
    Options,
    OwnEnv,
    UnknownTask,
)


@dataclass(frozen=True)
class Settings:
    """What a user may say of an environment that is not midway's.

    Attributes:
        success_distance: Distance between the goals below which one counts as reached.
        success_function: ``module:function`` of achieved and desired goals that says so.
        max_episode_steps: Steps of an episode, in place of the registered limit.
        action_bound: Bounds of actions that have none.
        step_seconds: Seconds that a step or a reset of all copies may take where other processes
            step them: one that takes longer is taken for hanging.
    """

    success_distance: float | None = None
    success_function: str | Function | None = None
    max_episode_steps: int | None = None
    action_bound: float | None = None
    step_seconds: float = 600.0


@dataclass(frozen=True)
class Foreign:
    """An environment that is not midway's, with all that was decided about it.

    Attributes:
        source: What makes it.
        spec: What agents may know of it; its task is the rule of success.
        settings: What the user said of it.
        seconds: Median time of one of its steps, where it was measured.
    """

    source: Source
    spec: EnvSpec
    settings: Settings = Settings()
    seconds: float = field(default=math.inf, compare=False)

    @property
    def rule(self) -> Rule:
        """The rule of success."""
        rule: Any = self.spec.task
        return rule  # type: ignore[no-any-return]

    @property
    def rule_is_its_own(self) -> bool:
        """Whether the rule is the environment's, which its info must not contradict."""
        given = (self.settings.success_distance, self.settings.success_function)
        return given == (None, None)

    @property
    def draws(self) -> bool:
        """Whether the environment draws itself."""
        metadata = getattr(judge(self.source), "metadata", {})
        return "rgb_array" in metadata.get("render_modes", ())

    @property
    def description(self) -> str:
        """What counts as success, as one line for the user."""
        return f"{self.spec.name}: a goal is reached {self.rule.description}"

    @property
    def stored(self) -> JsonObject | None:
        """What a run folder stores; None where only this process can make the environment."""
        try:
            return self.to_json()
        except ConfigurationError:
            return None

    def to_json(self) -> JsonObject:
        """Return what a run folder stores.

        Raises:
            ConfigurationError: No other process could make the environment or find its rule.
        """
        stored = {"source": self.source.to_json(), "success": self.rule.to_json()}
        settings = asdict(self.settings)
        function = self.settings.success_function
        if function is not None and not isinstance(function, str):
            settings["success_function"] = reference_of(function)[0]
        spec = replace(self.spec, task=UnknownTask()).to_json()
        return stored | {"settings": settings, "spec": spec, "seconds": self.seconds}

    @staticmethod
    def from_json(stored: Options) -> "Foreign":
        """Return the environment that ``to_json`` was taken from; nothing is decided again.

        Raises:
            ConfigurationError: It is none.
        """
        try:
            foreign = Foreign(
                source=Source.from_json(stored["source"]),
                spec=replace(
                    EnvSpec.from_json(stored["spec"]), task=success.from_json(stored["success"])
                ),
                settings=Settings(**stored["settings"]),
                seconds=float(stored["seconds"]),
            )
            for part in (foreign, foreign.source, foreign.spec.task, foreign.settings):
                check_kinds(part)
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
            raise ConfigurationError(f"stored environment cannot be read: {error}") from error
        return foreign


def describe(
    env: OwnEnv,
    settings: Settings | None = None,
    kwargs: Options | None = None,
    imports: tuple[str, ...] = (),
) -> Foreign:
    """Return an environment with all that must be decided about it; a few episodes are run.

    Args:
        env: A name, a callable that makes environments, or what ``gymnasium.make`` returned.
        settings: What the user says of it.
        kwargs: Keyword arguments of the environment.
        imports: Modules to import first.

    Raises:
        ConfigurationError: It cannot be made, is no goal environment, has no limit, or does not
            say when a goal is reached; the text says what to give.
    """
    settings = settings or Settings()
    if not settings.step_seconds > 0:
        raise ConfigurationError(f"step_seconds {settings.step_seconds}: must be positive")
    origin = source(env, kwargs, imports)
    name = origin.reference
    made = judge(origin)
    read = readings(name, made.observation_space)
    actions = _checked_actions(name, made.action_space, settings.action_bound)
    limit = _limit(name, made, settings.max_episode_steps)
    other = origin.make(limit)
    try:

        def probes(seed: int, steps: int) -> Probes:
            return probe(name, other, read, settings.action_bound, limit, seed, steps)

        seen = probe(name, other, read, settings.action_bound, limit)
        kind = "state" if "achieved_state" in read else "goal"
        evidence = deciding.Evidence(
            name=name,
            source=origin,
            judge=made,
            env=other,
            goal_shape=made.observation_space[f"desired_{kind}"].shape,
            probes=seen,
            more=lambda seed: probes(seed, 10 * len(seen.word)),
        )
        given = settings.success_distance, settings.success_function
        rule = deciding.given(evidence, *given) or deciding.own(evidence)
    finally:
        other.close()
    shape, center, spread, coordinates = _scales(name, seen, rule)
    spec = EnvSpec(
        name=name,
        observation_shape=shape,
        observation_dtype=read["observation"].dtype,
        goal_shape=read["desired_goal"].shape,
        action_dim=int(np.prod(actions.shape)),
        max_episode_steps=limit,
        goal_is_observation=seen.goal_is_observation,
        state_shape=read["desired_state"].shape if kind == "state" else None,
        task=rule,
        center=center,
        spread=spread,
        goal_coordinates=coordinates,
        can_fail=True,
    )
    return Foreign(origin, spec, settings, seen.seconds)


EnvLike: TypeAlias = str | Foreign | gymnasium.Env[Any, Any] | Function
"""What stands for an environment: a name, what `describe` returned, what ``gymnasium.make``
returned, or what makes it, such as its class."""


_ADMITTED: dict[str, Foreign] = {}


def admit(foreign: Foreign) -> Foreign:
    """Let an environment go by its name in this process, also one that only an object makes."""
    _ADMITTED[foreign.spec.name] = foreign
    return foreign


def described(env: EnvLike) -> Foreign:
    """Return the environment that was admitted by this name, else describe and admit it.

    Raises:
        ConfigurationError: As `describe`.
    """
    known = _ADMITTED.get(env) if isinstance(env, str) else None
    return known or admit(describe(env))


def with_limit(foreign: Foreign, max_episode_steps: int) -> Foreign:
    """Return the same environment with another number of steps in an episode."""
    settings = replace(foreign.settings, max_episode_steps=max_episode_steps)
    spec = replace(foreign.spec, max_episode_steps=max_episode_steps)
    return replace(foreign, spec=spec, settings=settings)


def _scales(
    name: str, probes: Probes, rule: Rule
) -> tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...], tuple[int, ...]]:
    """Return shape, middle and spread of an observation, and its entries that are the goal.

    Where the observation lacks the achieved goal, it is appended, so that a state tells its goal.
    Goals that were wished for count for the middle and the spread of these entries, and those of
    one distance have one spread.

    Raises:
        ConfigurationError: Observations are images, and goals are not.
    """
    seen, achieved = probes.observation, probes.achieved.astype(np.float32)
    if seen.ndim > 2:
        if not probes.goal_is_observation:
            raise ConfigurationError(
                f"{name}: it observes images but its goals are numbers: observe numbers, or give "
                "goals as images with achieved_state and desired_state beside them"
            )
        return seen.shape[1:], (), (), ()
    places = () if probes.goal_is_observation else _places(seen, achieved)
    if not probes.goal_is_observation and not places:
        places = tuple(range(seen.shape[1], seen.shape[1] + achieved.shape[1]))
        seen = np.concatenate([seen, achieved], axis=1)
    center, spread = seen.mean(0), seen.std(0)
    coordinates = np.array(places or range(seen.shape[1]))
    if achieved.shape[1] == len(coordinates):
        goals = np.concatenate([achieved, probes.desired])
        center[coordinates], spread[coordinates] = goals.mean(0), goals.std(0)
        for group in rule.groups if isinstance(rule, DistanceTask) else ():
            index = coordinates[list(group)]
            spread[index] = np.sqrt((spread[index] ** 2).mean())
    spread[spread < 1e-6] = 1.0
    return seen.shape[1:], tuple(center.tolist()), tuple(spread.tolist()), places


def _places(observations: Shaped[Array, "N S"], achieved: Shaped[Array, "N G"]) -> tuple[int, ...]:
    """Return for each entry of the goal that of the observation which it always is; or nothing."""
    same = (observations[:, :, None] == achieved[:, None, :]).all(0)
    same &= (np.ptp(achieved, axis=0) > 0)[None]  # what never changes is no evidence
    return tuple(same.argmax(0).tolist()) if same.any(0).all() else ()


def _checked_actions(name: str, space: AnySpace, bound: float | None) -> spaces.Box:
    """Return the space of continuous actions.

    Raises:
        ConfigurationError: They are discrete or have no bounds.
    """
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise ConfigurationError(
            f"{name}: its actions are {space}: midway's agents choose numbers within bounds (a Box "
            "of floats)"
        )
    if bound is not None and not 0 < bound < np.inf:
        raise ConfigurationError(f"action_bound {bound}: must be positive")
    if bound is None and not space.is_bounded():
        raise ConfigurationError(f"{name}: its actions have no bounds: give --action-bound B")
    return space


def _limit(name: str, env: OwnEnv, given: int | None) -> int:
    """Return the number of steps of an episode.

    Raises:
        ConfigurationError: None is registered nor given.
    """
    if given is not None:
        if given < 1:
            raise ConfigurationError(f"max_episode_steps {given}: must be at least 1")
        return given
    registered = getattr(env.spec, "max_episode_steps", None)
    limit = registered or _wrapped_limit(env)
    if limit is None:
        raise ConfigurationError(
            f"{name}: its episodes have no limit of steps: give --max-episode-steps N"
        )
    return int(limit)


def _wrapped_limit(env: OwnEnv) -> int | None:
    try:
        return int(env.get_wrapper_attr("_max_episode_steps"))
    except (AttributeError, TypeError, ValueError):
        return None
