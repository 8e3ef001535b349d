"""Containers and contracts that every floor shares."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Bool, Float, Shaped

Metrics: TypeAlias = dict[str, Float[Array, ""]]
"""Scalars on the device, named ``group/name``."""

ArrayLike: TypeAlias = Any
"""A NumPy or JAX array: the goal task is written for both."""


class ConfigurationError(ValueError):
    """A name, value or folder that the user gave cannot be used; its text is one clear line."""


class NonFiniteError(RuntimeError):
    """A loss or value became NaN or infinite; its text names the quantity."""


@runtime_checkable
class GoalTask(Protocol):
    """The one definition of success, shared by collection, replay, evaluation and tests."""

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Return reward ``(B,)`` float32, terminated ``(B,)`` bool for goals ``(B, goal_dim)``."""
        ...

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Return the distance to the goal ``(B,)`` that success is measured by."""
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

    def distance(self, achieved: ArrayLike, desired: ArrayLike) -> ArrayLike:
        """Raise a ConfigurationError: only the environment itself can tell."""
        raise ConfigurationError("what counts as reached is known to the environment alone")

    def __call__(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
        """Raise a ConfigurationError, as ``distance``."""
        return self.distance(achieved, desired), None


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(part) for part in value) if isinstance(value, list | tuple) else value


def _as_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
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

    def to_json(self) -> dict[str, Any]:
        """Return plain values; of the task only what `DistanceTask` holds."""
        values = asdict(self)
        values["task"] = asdict(self.task) if isinstance(self.task, DistanceTask) else None
        return values

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> "EnvSpec":
        """Return the specification of ``to_json``; a task that is not there judges nothing.

        Raises:
            ConfigurationError: A value is missing, unknown or has the wrong type.
        """
        try:
            plain = {name: _as_tuple(value) for name, value in values.items()}
            task = plain["task"]
            plain["task"] = UnknownTask() if task is None else DistanceTask(**_as_tuples(task))
            return EnvSpec(**plain)
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"environment not understood: {error}") from error


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


class Batch(NamedTuple):
    """Relabelled transitions; reward and terminated belong to ``goal``.

    ``outcome`` is what they were computed from; ``None`` where that is ``next_observation`` and
    ``goal``. The others are there where `Sampling` asks for them: ``steps`` from the observation to
    the next one, steps that the episode needed from the observation to the goal (infinite where
    it is not known to get there), and an observation between the two.
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
    reached_in: Float[Array, " B"] | None = None
    between: Shaped[Array, "B ..."] | None = None


@dataclass(frozen=True)
class Sampling:
    """What an agent wants of a batch besides transitions with relabelled goals.

    Attributes:
        n_step: Steps from an observation to its next observation, at most; the way ends earlier
            where the goal is reached or the episode ends.
        unreached: Whether goals that are reached in the observation itself are drawn again.
        reached_in: Whether `Batch.reached_in` is wanted.
        between: Whether `Batch.between` is wanted.
    """

    n_step: int = 1
    unreached: bool = False
    reached_in: bool = False
    between: bool = False


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


Observation: TypeAlias = Mapping[str, Any]
"""Goal-environment dictionary: observation, achieved_goal, desired_goal (and the two states)."""
