"""Which rows make a batch: pure functions on positions (appendix B, experience relabelling)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from midway.replay.storage import Live, ReplayState, bounds, live
from midway.types import RelabelMix


class Rows(NamedTuple):
    """Drawn rows, and the bounds of their episodes.

    Attributes:
        lane: Lane of each row.
        position: Position of each row in its lane.
        first: Position of its episode's goal row.
        last: Position of its episode's newest row.
    """

    lane: Int[Array, " B"]
    position: Int[Array, " B"]
    first: Int[Array, " B"]
    last: Int[Array, " B"]

    @property
    def is_state(self) -> Bool[Array, " B"]:
        """Whether the row holds a state, not a goal."""
        return self.position > self.first

    @property
    def is_transition(self) -> Bool[Array, " B"]:
        """Whether the row holds a state that has a successor."""
        return self.is_state & (self.position < self.last)


def draw_transitions(replay: ReplayState, batch_size: int, key: Key[Array, ""]) -> Rows:
    """Return rows drawn uniformly from all states that have a successor."""
    available = live(replay)
    return _draw(
        replay, available, available.transitions, lambda rows: rows.is_transition, batch_size, key
    )


def draw_states(replay: ReplayState, batch_size: int, key: Key[Array, ""]) -> Rows:
    """Return rows drawn uniformly from all states."""
    available = live(replay)
    return _draw(replay, available, available.states, lambda rows: rows.is_state, batch_size, key)


def _draw(
    replay: ReplayState,
    available: Live,
    wanted_per_lane: Int[Array, " K"],
    is_wanted: Callable[[Rows], Bool[Array, " B"]],
    batch_size: int,
    key: Key[Array, ""],
) -> Rows:
    """Draw lanes by their number of wanted rows, then live rows of the lane until wanted.

    Both steps are uniform over the wanted rows, so their product is. At least every fifth live row
    of a lane with transitions is one, so few rounds are needed; none if nothing is wanted at all.
    """
    lane_key, key = jax.random.split(key)
    ends = jnp.cumsum(wanted_per_lane)
    ticket = jax.random.randint(lane_key, (batch_size,), 0, jnp.maximum(ends[-1], 1))
    lane = jnp.sum(ticket[:, None] >= ends[:-1], axis=1, dtype=jnp.int32)

    def propose(key: Key[Array, ""]) -> Rows:
        offset = jax.random.randint(key, (batch_size,), 0, available.rows[lane])
        position = available.start[lane] + offset
        return Rows(lane, position, *bounds(replay, lane, position))

    def redraw(carry: tuple[Rows, Key[Array, ""]]) -> tuple[Rows, Key[Array, ""]]:
        rows, key = carry
        round_key, key = jax.random.split(key)
        keep = is_wanted(rows)
        return jax.tree.map(lambda a, b: jnp.where(keep, a, b), rows, propose(round_key)), key

    def unfinished(carry: tuple[Rows, Key[Array, ""]]) -> Bool[Array, ""]:
        return (ends[-1] > 0) & ~jnp.all(is_wanted(carry[0]))

    first_key, key = jax.random.split(key)
    return jax.lax.while_loop(unfinished, redraw, (propose(first_key), key))[0]


def source_counts(mix: RelabelMix, batch_size: int) -> tuple[int, int, int]:
    """Return how many goals of a batch are the episode's own, random and future ones.

    Counts are truncated and the remainder is future goals, as in the original implementation: 409,
    819, 820 of 2048. Where the mix has no future goals, the remainder goes to the source before.
    """
    own, random = int(batch_size * mix.own), int(batch_size * mix.random)
    if mix.future == 0:
        own = own if mix.random else batch_size
        random = batch_size - own
    return own, random, batch_size - own - random


def goal_rows(
    replay: ReplayState, pairs: Rows, mix: RelabelMix, key: Key[Array, ""]
) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
    """Return lane and position of the row that holds the goal of each drawn transition.

    The batch is split into one block for each source; transitions are independent draws, so this
    favours none. Future goals are uniform over the later states of the episode, the transition's
    own next state included.
    """
    own, random, _ = source_counts(mix, pairs.lane.shape[0])
    random_key, future_key = jax.random.split(key)
    states = draw_states(replay, random, random_key)
    future = jax.tree.map(lambda leaf: leaf[own + random :], pairs)
    later = jax.random.randint(
        future_key, future.position.shape, future.position + 1, future.last + 1
    )
    lane = jnp.concatenate([pairs.lane[:own], states.lane, future.lane])
    return lane, jnp.concatenate([pairs.first[:own], states.position, later])
