"""The contract between an agent and everything else: one frozen value of functions.

An agent file ends in one `Agent`. What not every agent can do is a field that may be None, and
whoever needs it asks for the field, never for a name.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from midway.types import (
    AnyArray,
    Batch,
    Dataclass,
    EnvSpec,
    Hyperparameters,
    Metrics,
    Sampling,
    Subgoal,
)


@runtime_checkable
class AgentState(Dataclass, Protocol):
    """What every agent's state holds besides its networks and optimisers."""

    @property
    def config(self) -> Hyperparameters:
        """The agent's configuration, a static part of the state."""

    @property
    def spec(self) -> EnvSpec:
        """What the networks were made for, a static part of the state."""


ConfigT = TypeVar("ConfigT")
StateT = TypeVar("StateT", bound=AgentState)

Memory: TypeAlias = PyTree
"""What an agent remembers of running episodes: arrays with one row for each."""

Inputs: TypeAlias = Shaped[Array, "B ..."]
"""Observations or goals, as the environment shows them."""

Encoder: TypeAlias = Callable[[Inputs], Float[Array, "B F"]]
"""From images to the features that networks read: a module whose arrays are its weights."""


class SubgoalDistribution(NamedTuple):
    """Independent Laplace variables over subgoals, in the environment's units."""

    location: Subgoal
    scale: Subgoal


@dataclass(frozen=True)
class Value(Generic[StateT]):
    """What an agent thinks of a goal.

    Attributes:
        estimate: ``(state, observation, goal) -> V(s, g)``, shape ``(B,)``; larger is nearer.
        unit: What the numbers are, for the axes of figures.
    """

    estimate: Callable[[StateT, Inputs, Inputs], Float[Array, " B"]]
    unit: str


class Plan(NamedTuple):
    """Subgoals that B episodes follow, or the B actions of one; and which of them is due.

    They are achieved goals in the environment's units. The last one is due when the goal itself is.
    """

    subgoals: Float[AnyArray, "B N G"]
    due: Int[AnyArray, " B"]


@dataclass(frozen=True)
class EpisodeMemory(Generic[ConfigT, StateT]):
    """What an agent carries from one step of an episode to the next.

    Attributes:
        begin: ``(config, spec, num_episodes) -> memory`` before the first step of each episode.
        act: ``(state, memory, observation, goal, key, explore) -> (actions, memory)``.
        rest: ``(memory, done) -> memory`` where the episodes of a mask are over, so that nothing
            is computed for them; None where a step costs the same anyway.
        plan: ``(state, memory) -> Plan`` that the last action followed; None for an agent that
            plans nothing.
        adapt: ``(config, memory, ways) -> memory`` before the first step, where it is known how
            far the goals are: ``ways (B,)`` are shares of the environment's longest way. None for
            an agent that needs not know.
    """

    begin: Callable[[ConfigT, EnvSpec, int], Memory]
    act: Callable[
        [StateT, Memory, Inputs, Inputs, Key[Array, ""], bool], tuple[Float[Array, "B A"], Memory]
    ]
    rest: Callable[[Memory, Bool[AnyArray, " B"]], Memory] | None = None
    plan: Callable[[StateT, Memory], Plan] | None = None
    adapt: Callable[[ConfigT, Memory, Float[AnyArray, " B"]], Memory] | None = None


@dataclass(frozen=True)
class PretrainSettings:
    """How much an agent learns before the first update.

    Attributes:
        networks: Parts of the agent's state that this trains; they are saved and can be reused.
        states: Number of states.
        random_actions: Actions taken after each reset; the states before and after each are used.
        rounds: Calls of ``Pretrain.round``.
        source: Run folder whose networks are taken instead, or nothing.
    """

    networks: tuple[str, ...]
    states: int
    random_actions: int
    rounds: int
    source: str = ""


@dataclass(frozen=True)
class Pretrain(Generic[ConfigT, StateT]):
    """What an agent learns from states of the environment before the first update.

    Attributes:
        settings: ``config -> PretrainSettings``.
        round: ``(state, states, key) -> (state, metrics)``.
        reconstruct: ``(state, states) -> states`` as the pre-trained networks keep them; for
            images numbers around [0, 1].
    """

    settings: Callable[[ConfigT], PretrainSettings]
    round: Callable[[StateT, Subgoal, Key[Array, ""]], tuple[StateT, Metrics]]
    reconstruct: Callable[[StateT, Subgoal], Shaped[Array, "N ..."]]


@dataclass(frozen=True)
class Freezing(Generic[StateT]):
    """How an agent of images becomes one of the features that its frozen encoder makes of them.

    Attributes:
        encoder: ``state -> Encoder``.
        at_start: Whether the encoder is ready before the first update (it was pre-trained).
        kept: Parts of the state that the agent created for the features takes over.
    """

    encoder: Callable[[StateT], Encoder]
    at_start: bool = False
    kept: tuple[str, ...] = ()


@dataclass(frozen=True)
class Agent(Generic[ConfigT, StateT]):
    """An algorithm as pure functions; it never sees an environment, a logger or a file.

    Attributes:
        Config: A frozen dataclass of its hyperparameters.
        create: ``(config, spec, key) -> state``: networks and optimisers at their start.
        update: ``(state, batch, key) -> (state, metrics)``: one gradient step of every network.
        act: ``(state, observation, goal, key, explore) -> actions (B, A)`` in [-1, 1]: sampled
            where ``explore``, else deterministic; with a memory, those of an episode's first step.
        networks: Parts of the state that a saved policy holds: what acts and what reports read. No
            target networks.
        value: Its estimate of V(s, g), if it has one.
        subgoals: ``(state, observation, goal) -> SubgoalDistribution``, if it imagines subgoals.
        memory: What it remembers of an episode, if anything.
        pretrain: What it learns before the first update, if anything.
        sampling: ``config -> Sampling``: what it wants of a batch; None for plain transitions.
        freezing: How its image encoder is frozen; None if it reads no images.
        test_settings: Settings that a trained policy may be given other values of: those that its
            networks and what they learned do not depend on.
    """

    Config: type[ConfigT]
    create: Callable[[ConfigT, EnvSpec, Key[Array, ""]], StateT]
    update: Callable[[StateT, Batch, Key[Array, ""]], tuple[StateT, Metrics]]
    act: Callable[[StateT, Inputs, Inputs, Key[Array, ""], bool], Float[Array, "B A"]]
    networks: tuple[str, ...]
    value: Value[StateT] | None = None
    subgoals: Callable[[StateT, Inputs, Inputs], SubgoalDistribution] | None = None
    memory: EpisodeMemory[ConfigT, StateT] | None = None
    pretrain: Pretrain[ConfigT, StateT] | None = None
    sampling: Callable[[ConfigT], Sampling] | None = None
    freezing: Freezing[StateT] | None = None
    test_settings: tuple[str, ...] = ()


AnyAgent: TypeAlias = Agent[Any, Any]
"""An agent whose configuration and state are its own business."""
