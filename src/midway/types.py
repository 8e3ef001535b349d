"""Containers and contracts that every floor shares."""

from collections.abc import Callable, Mapping
from dataclasses import Field, asdict, dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from midway.errors import ConfigurationError
from midway.plain import check_kinds

Metrics: TypeAlias = dict[str, Float[Array, ""]]
"""Scalars on the device, named ``group/name``."""

NumPyArray: TypeAlias = np.ndarray[Any, np.dtype[Any]]
AnyArray: TypeAlias = NumPyArray | Array
"""What is taken by compiled functions."""

ArrayLike: TypeAlias = Any
"""A NumPy or JAX array, or a scalar of one: the goal task gives what it is given."""

Observation: TypeAlias = Mapping[str, AnyArray]
"""Goal-environment dictionary: observation, achieved_goal, desired_goal (and the two states)."""
Observations: TypeAlias = dict[str, NumPyArray]
"""The same as a vector environment gives it, with one row for each copy."""
Info: TypeAlias = dict[str, NumPyArray]
"""What a vector environment says besides, with one value for each copy."""
Step: TypeAlias = tuple[Observations, NumPyArray, NumPyArray, NumPyArray, Info]
"""Observations, reward, terminated, truncated and info."""
Options: TypeAlias = Mapping[str, Any]
"""Values by name that whoever reads them checks: of a reset ``reset_mask``, ``task`` and others."""

OwnEnv: TypeAlias = Any
"""An environment of others, with methods of its own: ``compute_reward`` and the like."""
NamedValues: TypeAlias = dict[str, Any]
"""What an environment of others says besides, or is told."""
Function: TypeAlias = Callable[..., Any]
"""A function of a user or of a package, whose arguments it says itself."""

LARGEST_SIZE = 1_000_000
"""Entries along an axis of what environments show, and steps of an episode, at most."""

JsonObject: TypeAlias = dict[str, Any]
"""What a JSON file holds; whoever reads it checks the values."""


@runtime_checkable
class Dataclass(Protocol):
    """An instance of any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Hyperparameters: TypeAlias = Dataclass
"""A frozen dataclass of settings (`midway.settings`)."""


@runtime_checkable
class GoalTask(Protocol):
    """The one definition of success, shared by collection, replay, evaluation and tests."""

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Return reward ``(B,)`` float32, terminated ``(B,)`` bool for goals ``(B, goal_dim)``."""
        ...

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return the distance to the goal ``(B,)`` that success is measured by."""
        ...

    @property
    def description(self) -> str:
        """When a goal counts as reached, as the end of a sentence for the user."""
        ...


@dataclass(frozen=True)
class DistanceTask:
    """Reward -1 on every step; terminated when every group of coordinates is near its goal.

    Attributes:
        groups: Indices of the coordinates of each Euclidean distance, such as ``((0, 1),)`` for
            the x-y position of an ant or ``((0, 1), (2, 3))`` for hand and puck.
        threshold: Largest distance, not included, that counts as success (m).
        names: What each group is, such as ``("hand", "puck")``, where they are told apart.
    """

    groups: tuple[tuple[int, ...], ...]
    threshold: float
    names: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """When a goal counts as reached, as the end of a sentence for the user."""
        parts = self.names or [f"coordinates {list(group)}" for group in self.groups]
        return f"within {self.threshold:.6g} of the goal in {' and '.join(parts)}"

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return the largest of the groups' distances ``(B,)`` (m)."""
        largest, *others = self._distances(achieved, desired)
        for other in others:
            largest = largest * (largest >= other) + other * (other > largest)
        return largest

    def named_distances(self, achieved: ArrayLike, desired: ArrayLike) -> dict[str, ArrayLike]:
        """Return the distance of each group ``(B,)`` by its name (m); nothing without names."""
        return dict(zip(self.names, self._distances(achieved, desired), strict=False))

    def _distances(self, achieved: ArrayLike, desired: ArrayLike) -> list[ArrayLike]:
        difference = achieved - desired
        return [
            sum(difference[..., i] ** 2 for i in group) ** 0.5  # type: ignore[operator]
            for group in self.groups
        ]

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Return reward ``(B,)``, always -1, and terminated ``(B,)``."""
        distance = self.distance(achieved, desired)
        return (0 * distance - 1).astype("float32"), distance < self.threshold


@dataclass(frozen=True)
class UnknownTask:
    """Success of an environment whose rule is not stored with the policy."""

    description = "as the environment alone knows"

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Raise a ConfigurationError: only the environment itself can tell."""
        raise ConfigurationError("what counts as reached is known to the environment alone")

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Raise a ConfigurationError, as ``distance``."""
        distance = self.distance(achieved, desired)
        return distance, distance


def _as_tuple(value: object) -> object:
    return tuple(_as_tuple(part) for part in value) if isinstance(value, list | tuple) else value


def _as_tuples(values: JsonObject) -> JsonObject:
    return {name: _as_tuple(value) for name, value in values.items()}


@dataclass(frozen=True)
class EnvSpec:
    """What agents and replay may know of an environment.

    Attributes:
        name: The name that users type, such as ``ant-u``.
        observation_shape: Shape of one observation.
        observation_dtype: ``float32``, or ``uint8`` for images.
        goal_shape: Shape of one achieved or desired goal.
        action_dim: Number of actions, each in [-1, 1].
        max_episode_steps: Steps after which an episode is truncated.
        goal_is_observation: Whether the achieved goal is the observation itself (the paper's case).
        state_shape: Shape of ``achieved_state`` where success is measured on a state that the
            networks never see; ``None`` where it is measured on the goals.
        task: The definition of success.
        origin: Middle of the states, nothing for zeros; only where goals are observations.
        unit: What networks count in: of a state, they read (state - origin) / unit.
        center: Typical middle of each entry of an observation; nothing where it is not known.
        spread: Typical deviation of each entry from it.
        image_shape: Shape of the images that a frozen encoder made these observations of; ``None``
            where they are the environment's own.
        goal_coordinates: Entries of the observation that are the achieved goal, where goals are not
            observations; nothing where that is not known.
        can_fail: Whether the environment may end an episode before its goal is reached.
    """

    name: str
    observation_shape: tuple[int, ...]
    observation_dtype: str
    goal_shape: tuple[int, ...]
    action_dim: int
    max_episode_steps: int
    goal_is_observation: bool
    state_shape: tuple[int, ...] | None
    task: GoalTask
    origin: tuple[float, ...] = ()
    unit: float = 1.0
    center: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()
    image_shape: tuple[int, ...] | None = None
    goal_coordinates: tuple[int, ...] = ()
    can_fail: bool = False

    @property
    def is_image(self) -> bool:
        """Whether observations and goals are images."""
        return len(self.observation_shape) == 3

    def encoded(self, num_features: int) -> "EnvSpec":
        """Return the specification of the features that a frozen encoder makes of the images."""
        return replace(
            self,
            observation_shape=(num_features,),
            observation_dtype="float32",
            goal_shape=(num_features,),
            goal_is_observation=True,
            image_shape=self.observation_shape,
        )

    def to_json(self) -> JsonObject:
        """Return plain values; of the task only what `DistanceTask` holds."""
        values = asdict(self)
        rule = {field.name: getattr(self.task, field.name, None) for field in fields(DistanceTask)}
        values["task"] = rule if isinstance(self.task, DistanceTask) else None
        return values

    @staticmethod
    def from_json(values: JsonObject) -> "EnvSpec":
        """Return the specification of ``to_json``; a task that is not there judges nothing.

        Raises:
            ConfigurationError: A value is missing, unknown or has the wrong type.
        """
        try:
            plain = _as_tuples(values)
            task = plain["task"]
            plain["task"] = UnknownTask() if task is None else DistanceTask(**_as_tuples(task))
            spec = EnvSpec(**plain)
            check_kinds(spec.task)
            check_kinds(spec)
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ConfigurationError(f"environment not understood: {error}") from error
        spec._check_sizes()
        return spec

    def _check_sizes(self) -> None:
        """Check shapes and what counts their entries.

        Raises:
            ConfigurationError: They cannot be those of an environment.
        """
        shapes = (self.observation_shape, self.goal_shape, self.state_shape, self.image_shape)
        given = [shape for shape in shapes if shape is not None]
        sizes = [self.action_dim, self.max_episode_steps, *(size for s in given for size in s)]
        measured = self.state_shape or self.goal_shape
        groups = self.task.groups if isinstance(self.task, DistanceTask) else ((0,),)
        entries = [index for group in groups for index in group]
        if not (
            all(1 <= size <= LARGEST_SIZE for size in sizes)
            and all(len(shape) in (1, 3) for shape in given)
            and self.observation_dtype in ("float32", "uint8")
            and all(groups)
            and all(0 <= index < measured[0] for index in entries)
            and all(0 <= index < self.observation_shape[0] for index in self.goal_coordinates)
            and all(len(x) in (0, self.observation_shape[0]) for x in (self.center, self.spread))
        ):
            raise ConfigurationError(f"environment not understood: sizes of {self.name}")


@runtime_checkable
class VectorGoalEnv(Protocol):
    """Copies of a goal environment that are stepped together and reset by a mask."""

    @property
    def goal_spec(self) -> EnvSpec:
        """What agents may know of the environment."""

    @property
    def num_envs(self) -> int:
        """Number of copies."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks."""

    @property
    def resumable(self) -> bool:
        """Whether ``load_state_dict`` continues in the middle of the episodes."""

    @property
    def logged_info(self) -> Mapping[str, str]:
        """Info whose mean over the steps of collection is logged, with its name there."""

    def reset(
        self, *, seed: int | None = None, options: Options | None = None
    ) -> tuple[Observations, Info]:
        """Start new episodes."""
        ...

    def step(self, actions: NumPyArray) -> Step:
        """Move every copy by one step."""
        ...

    def rest(self, mask: Bool[NumPyArray, " num_envs"]) -> Observations:
        """Ask no more of these copies, whose episodes are over, until they are reset."""
        ...

    def ways(self) -> Float[NumPyArray, " num_envs"]:
        """Return how far the goals are, as shares of the longest way; ones where not known."""
        ...

    def state_dict(self) -> dict[str, NumPyArray]:
        """Return all that the future depends on."""
        ...

    def load_state_dict(self, state: Mapping[str, NumPyArray]) -> None:
        """Continue from a ``state_dict``."""


class Subgoal(NamedTuple):
    """A state in both of its roles: one that is reached, and one that is started from.

    Where the goal is the observation itself, both are the same array.
    """

    observation: Shaped[Array, "B ..."]
    achieved_goal: Shaped[Array, "B ..."]


class Outcome(NamedTuple):
    """What success is measured on: the goals, or the true states where the goals are images."""

    achieved: Float[Array, "B D"]
    desired: Float[Array, "B D"]


class Trajectory(NamedTuple):
    """One episode, or a part of one with a single goal.

    Attributes:
        observations: What is observed from the start to the last state ``(T + 1, ...)``, by name.
        actions: The actions between them ``(T, action_dim)``, in [-1, 1].
    """

    observations: dict[str, NumPyArray]
    actions: NumPyArray


class Batch(NamedTuple):
    """Relabelled transitions; reward and terminated belong to ``goal``.

    ``outcome`` is what they were computed from; ``None`` where that is ``next_observation`` and
    ``goal``. ``steps``: from the observation to the next one, where `Sampling` asks for several.
    ``failed``: whether the environment ended the episode there without success; where it may.
    """

    observation: Shaped[Array, "B ..."]
    action: Float[Array, "B action_dim"]
    reward: Float[Array, " B"]
    terminated: Bool[Array, " B"]
    next_observation: Shaped[Array, "B ..."]
    goal: Shaped[Array, "B ..."]
    subgoal_candidate: Subgoal
    outcome: Outcome | None = None
    steps: Float[Array, " B"] | None = None
    failed: Bool[Array, " B"] | None = None


@dataclass(frozen=True)
class Sampling:
    """What an agent wants of a batch besides transitions with relabelled goals.

    Attributes:
        n_step: Steps from an observation to its next observation, at most; the way ends earlier
            where the goal is reached or the episode ends.
        unreached: Whether goals that are reached in the observation itself are drawn again.
    """

    n_step: int = 1
    unreached: bool = False


@dataclass(frozen=True)
class RelabelMix:
    """Shares of a batch by the source of its goals (appendix B, experience relabelling).

    Attributes:
        own: Goal that the episode was collected with.
        random: Achieved goal of a random state of the replay.
        future: Achieved goal of a later state of the same episode.
        future_discount: A state k steps later is drawn in proportion to this to the power k; 1
            draws uniformly from the rest of the episode, as hindsight relabelling does.
    """

    own: float = 0.2
    random: float = 0.4
    future: float = 0.4
    future_discount: float = 1.0

    def __post_init__(self) -> None:
        """Check the shares.

        Raises:
            ConfigurationError: A share is negative, their sum is not 1, or the discount is not in
                (0, 1].
        """
        shares = (self.own, self.random, self.future)
        if min(shares) < 0 or abs(sum(shares) - 1) > 1e-6:
            raise ConfigurationError(
                f"relabel mix {shares}: the shares (own, random, future) must be >= 0 and add to 1"
            )
        if not 0 < self.future_discount <= 1:
            raise ConfigurationError(
                f"relabel mix, future_discount {self.future_discount}: must be above 0, at most 1"
            )
