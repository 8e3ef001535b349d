"""The ring: K lanes of rows on the learner's device, one lane for each parallel environment.

An episode is a contiguous block of rows in its lane: one goal row, then the rows of s_0 ... s_T.
The row of s_t also holds the action taken in s_t, so the next observation is the next row and
nothing is stored twice. Rows are named by their *position*, counted from the lane's first row; the
row at a position lies in slot ``position % L``, until position + L overwrites it. An episode that
is withdrawn gives its positions back, but not what its rows have overwritten.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree, Shaped

from midway.types import AnyArray


class ReplayState(NamedTuple):
    """The ring as a plain pytree of arrays: K lanes of L rows, table of E = L // 3 + 1 episodes.

    Attributes:
        rows: Contents of the rows by name: ``observation``, ``action``, and where the environment
            has them ``achieved_goal`` and ``achieved_state``.
        episode: Serial number in its lane of the episode that a row belongs to.
        first: Position of the goal row of an episode, at its serial number modulo E. An episode
            ends where the next one begins, so no other bound is needed.
        num_rows: Rows in each lane since the start without those withdrawn, fewer than 2**31.
        num_episodes: Episodes begun in each lane since the start, without those withdrawn.
        written: Positions of each lane that have been written: `num_rows`, or more after an
            episode was withdrawn. Rows from ``written - L`` on are there.
    """

    rows: dict[str, Shaped[Array, "K L ..."]]
    episode: Int[Array, "K L"]
    first: Int[Array, "K E"]
    num_rows: Int[Array, " K"]
    num_episodes: Int[Array, " K"]
    written: Int[Array, " K"]


class Live(NamedTuple):
    """What can be drawn from each lane: its newest episodes whose goal row is still there.

    Attributes:
        start: Position of the oldest such episode's goal row.
        rows: Rows from there on.
        episodes: Episodes among them, the running one included.
    """

    start: Int[Array, " K"]
    rows: Int[Array, " K"]
    episodes: Int[Array, " K"]

    @property
    def states(self) -> Int[Array, " K"]:
        """Rows that hold a state: all but the goal rows."""
        return self.rows - self.episodes

    @property
    def transitions(self) -> Int[Array, " K"]:
        """Rows that hold a state with a successor: all but goal rows and newest states."""
        return self.rows - 2 * self.episodes


def allocate(
    kinds: Mapping[str, tuple[tuple[int, ...], str]], num_lanes: int, lane_rows: int
) -> ReplayState:
    """Return an empty ring of ``num_lanes`` lanes for rows of the given shapes and dtypes."""
    rows = {
        name: jnp.zeros((num_lanes, lane_rows, *shape), dtype)
        for name, (shape, dtype) in kinds.items()
    }
    return ReplayState(
        rows=rows,
        episode=jnp.zeros((num_lanes, lane_rows), jnp.int32),
        first=jnp.zeros((num_lanes, lane_rows // 3 + 1), jnp.int32),
        num_rows=jnp.zeros(num_lanes, jnp.int32),
        num_episodes=jnp.zeros(num_lanes, jnp.int32),
        written=jnp.zeros(num_lanes, jnp.int32),
    )


def insert(
    array: Shaped[Array, "K L ..."],
    index: Int[Array, " K"],
    values: AnyArray,
    mask: Bool[Array, " K"],
) -> Shaped[Array, "K L ..."]:
    """Write ``values`` ``(K, ...)`` at ``index`` modulo L of the masked lanes."""
    num_lanes, size = array.shape[:2]
    # An index outside the array is dropped: masked-off lanes cost neither a read nor a copy.
    target = jnp.where(mask, index % size, size)
    values = jnp.asarray(values, array.dtype)
    return array.at[jnp.arange(num_lanes), target].set(values, mode="drop", unique_indices=True)


def write(
    replay: ReplayState,
    position: Int[Array, " K"],
    values: Mapping[str, AnyArray],
    mask: Bool[Array, " K"],
) -> ReplayState:
    """Write the named values ``(K, ...)`` into the rows at ``position`` of the masked lanes."""
    written = {
        name: insert(replay.rows[name], position, value, mask) for name, value in values.items()
    }
    return replay._replace(rows={**replay.rows, **written})


def read(
    replay: ReplayState, name: str, lane: Int[Array, " B"], position: Int[Array, " B"]
) -> Shaped[Array, "B ..."]:
    """Return the named contents ``(B, ...)`` of the rows at these positions."""
    array = replay.rows[name]
    return array.at[lane, position % array.shape[1]].get(mode="promise_in_bounds")


def live(replay: ReplayState) -> Live:
    """Return what can be drawn from each lane, in constant time.

    The episode of the lane's oldest row has lost its goal row, unless that row is its goal row; it
    is dropped whole. So at most one episode per lane is stored in part and not drawn.
    """
    num_lanes, lane_rows = replay.episode.shape
    lane = jnp.arange(num_lanes)
    oldest = jnp.maximum(replay.written - lane_rows, 0)
    serial = replay.episode[lane, oldest % lane_rows]
    serial = jnp.where(episode_first(replay, lane, serial) == oldest, serial, serial + 1)
    start = episode_end(replay, lane, serial - 1)
    return Live(start, replay.num_rows - start, replay.num_episodes - serial)


def episode_first(
    replay: ReplayState, lane: Int[Array, " B"], serial: Int[Array, " B"]
) -> Int[Array, " B"]:
    """Return the position of the goal row of these episodes."""
    index = serial % replay.first.shape[1]
    return replay.first.at[lane, index].get(mode="promise_in_bounds")


def episode_end(
    replay: ReplayState, lane: Int[Array, " B"], serial: Int[Array, " B"]
) -> Int[Array, " B"]:
    """Return the position after the last row of these episodes."""
    running = serial + 1 >= replay.num_episodes[lane]
    return jnp.where(running, replay.num_rows[lane], episode_first(replay, lane, serial + 1))


def bounds(
    replay: ReplayState, lane: Int[Array, " B"], position: Int[Array, " B"]
) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
    """Return the positions of the goal row and of the newest row of these rows' episodes."""
    slot = position % replay.episode.shape[1]
    serial = replay.episode.at[lane, slot].get(mode="promise_in_bounds")
    return episode_first(replay, lane, serial), episode_end(replay, lane, serial) - 1


def num_bytes(replay: PyTree) -> int:
    """Return the size of all arrays (or of their shapes) in bytes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(replay))
