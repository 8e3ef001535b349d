"""Acting, with agents that remember something of their running episodes and with those that do not.

The memory of an agent that remembers nothing is an empty tree, which costs nothing.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, Shaped

from midway.agent import AgentState, AnyAgent, Inputs, Memory
from midway.types import AnyArray, EnvSpec, Hyperparameters, NumPyArray

Seen = Shaped[AnyArray, "B ..."]
"""Observations or goals, on their way to a compiled function."""

Act = Callable[[Memory, Seen, Seen, Key[Array, ""]], tuple[Float[Array, "B action_dim"], Memory]]
"""``(memory, observation, goal, key) -> (actions, memory)``."""


Ways = Float[AnyArray, " B"]
"""How far goals are from where episodes begin, as shares of the environment's longest way."""


def begin(
    agent: AnyAgent,
    config: Hyperparameters,
    spec: EnvSpec,
    num_episodes: int,
    ways: Ways | None = None,
) -> Memory:
    """Return what the agent remembers before the first step of each episode."""
    if agent.memory is None:
        return ()
    memory = agent.memory.begin(config, spec, num_episodes)
    if ways is None or agent.memory.adapt is None:
        return memory
    return agent.memory.adapt(config, memory, ways)


def act(
    agent: AnyAgent,
    state: AgentState,
    memory: Memory,
    observation: Inputs,
    goal: Inputs,
    key: Key[Array, ""],
    *,
    explore: bool,
) -> tuple[Float[Array, "B action_dim"], Memory]:
    """Return actions ``(B, action_dim)`` and the memory after them."""
    if agent.memory:
        return agent.memory.act(state, memory, observation, goal, key, explore)
    return agent.act(state, observation, goal, key, explore), memory


def renew(memory: Memory, fresh: Memory, begun: Bool[AnyArray, " B"]) -> Memory:
    """Return the memory with its rows of newly begun episodes taken from ``fresh``."""

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(jnp.reshape(begun, (-1, *[1] * (new.ndim - 1))), new, old)

    return jax.tree.map(choose, fresh, memory)


class Actor:
    """A policy in the middle of its episodes, ``actor(observation, goal) -> actions``.

    Its first call begins an episode in every environment.

    Args:
        agent: The agent, for what it does with episodes that are over.
        act: The policy on a memory.
        begin: Returns the memory of as many new episodes, with ways to their goals if known.
        key: Key of all draws.

    Attributes:
        adapts: Whether it acts differently where it knows the ways to the goals.
        ways: These ways, if they are known before the first call.
    """

    def __init__(
        self,
        agent: AnyAgent,
        act: Act,
        begin: Callable[[int, Ways | None], Memory],
        key: Key[Array, ""],
    ) -> None:
        self.adapts = agent.memory is not None and agent.memory.adapt is not None
        self.ways: Ways | None = None
        self._rest = agent.memory.rest if agent.memory else None
        self._act = act
        self._begin = begin
        self._key = key
        self._calls = 0
        self.memory: Memory = None

    def __call__(self, observation: Seen, goal: Seen) -> NumPyArray:
        """Return actions ``(B, action_dim)`` for one step of every environment."""
        if self._calls == 0:
            self.memory = self._begin(len(observation), self.ways)
        key = jax.random.fold_in(self._key, self._calls)
        self._calls += 1
        actions, self.memory = self._act(self.memory, observation, goal, key)
        return np.asarray(actions)

    def rest(self, done: Bool[AnyArray, " B"]) -> None:
        """Compute nothing more than needed for these episodes, which are over."""
        if self._rest is not None:
            self.memory = self._rest(self.memory, done)
