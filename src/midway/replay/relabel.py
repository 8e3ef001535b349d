"""Which rows make a batch: pure functions on positions (appendix B, experience relabelling)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, UInt32

from midway.replay.storage import ReplayState, bounds, live
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


def draw(replay: ReplayState, has_next: Bool[Array, " B"], key: Key[Array, ""]) -> Rows:
    """Return independent rows, each uniform over all states; over those with a next if asked.

    Draws a lane by its number of such rows, then any live row of that lane until it is one: both
    steps are uniform, so their product is. Of the live rows of a lane with a transition at least
    every fifth is one, so few rounds are needed. All rows are drawn in one loop, which compiles and
    runs faster than one loop for each use. Without any transition the rows have no meaning.
    """
    available = live(replay)
    ends = jnp.cumsum(available.states), jnp.cumsum(available.transitions)
    ticket, number = jax.random.bits(jax.random.fold_in(key, 0), (2, *has_next.shape))
    ticket = below(ticket, jnp.where(has_next, ends[1][-1], ends[0][-1]))
    lane_ends = jnp.where(has_next[:, None], ends[1], ends[0])
    lane = jnp.sum(ticket[:, None] >= lane_ends[:, :-1], axis=1, dtype=jnp.int32)

    def propose(number: UInt32[Array, " B"]) -> Rows:
        position = available.start[lane] + below(number, available.rows[lane])
        return Rows(lane, position, *bounds(replay, lane, position))

    def wanted(rows: Rows) -> Bool[Array, " B"]:
        return (rows.first < rows.position) & (rows.position + has_next <= rows.last)

    def redraw(carry: tuple[Rows, Int[Array, ""]]) -> tuple[Rows, Int[Array, ""]]:
        rows, attempt = carry
        keep = wanted(rows)
        new = propose(jax.random.bits(jax.random.fold_in(key, attempt), has_next.shape))
        return jax.tree.map(lambda old, new: jnp.where(keep, old, new), rows, new), attempt + 1

    def unfinished(carry: tuple[Rows, Int[Array, ""]]) -> Bool[Array, ""]:
        return (ends[1][-1] > 0) & ~jnp.all(wanted(carry[0]))

    return jax.lax.while_loop(unfinished, redraw, (propose(number), jnp.int32(1)))[0]


def below(number: UInt32[Array, " B"], bound: Int[Array, " B"]) -> Int[Array, " B"]:
    """Return 32 random bits modulo the bound: uniform up to a share of bound / 2**32."""
    return (number % jnp.maximum(bound, 1).astype(jnp.uint32)).astype(jnp.int32)


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
    pairs: Rows, states: Rows, mix: RelabelMix, key: Key[Array, ""]
) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
    """Return lane and position of the row that holds the goal of each drawn transition.

    The batch is split into one block for each source; transitions are independent draws, so this
    favours none. Random goals are the drawn ``states``. Future goals are later states of the
    episode, the transition's own next state included.
    """
    own, random, _ = source_counts(mix, pairs.lane.shape[0])
    future = jax.tree.map(lambda leaf: leaf[own + random :], pairs)
    steps = steps_ahead(future.last - future.position, mix.future_discount, key)
    lane = jnp.concatenate([pairs.lane[:own], states.lane, future.lane])
    return lane, jnp.concatenate([pairs.first[:own], states.position, future.position + steps])


def steps_ahead(left: Int[Array, " B"], discount: float, key: Key[Array, ""]) -> Int[Array, " B"]:
    """Return how far ahead the future goals lie, from 1 to the steps that are left.

    Uniform for a discount of 1, else P(k) ∝ discount^k: the discounted distribution over future
    states, cut off where the episode ends.
    """
    if discount == 1:
        return 1 + below(jax.random.bits(key, left.shape), left)
    uniform = jax.random.uniform(key, left.shape)
    kept = 1 - discount ** left.astype(jnp.float32)
    ahead = jnp.floor(jnp.log1p(-uniform * kept) / jnp.log(discount)).astype(jnp.int32)
    return 1 + jnp.clip(ahead, 0, jnp.maximum(left, 1) - 1)
