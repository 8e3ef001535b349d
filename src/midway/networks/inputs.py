"""What networks read of a state and a goal: the whole goal, or where it lies (beyond the paper)."""

from dataclasses import replace
from typing import Literal, TypeAlias, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from midway.networks import encoder as encoders
from midway.networks.encoder import Encoder
from midway.types import DistanceTask, EnvSpec

GoalInputs: TypeAlias = Literal["whole", "coordinates", "relative"]
GOAL_INPUTS: tuple[GoalInputs, ...] = get_args(GoalInputs)


class PairInputs(eqx.Module):
    """Reads a goal as the coordinates that success is measured on, and relative to the state.

    Attributes:
        groups: Coordinates of each distance that success is measured by; none for the whole goal.
        near: Distance that counts as reached, in the units of the features; 0 leaves out where the
            goal lies from the state.
        places: Entry of the state for each coordinate of a goal, where goals are not states.
    """

    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    near: float = eqx.field(static=True, default=0.0)
    places: tuple[int, ...] = eqx.field(static=True, default=())

    @property
    def coordinates(self) -> tuple[int, ...]:
        """The entries of the state in all groups."""
        return tuple(place for group in self.groups for place in self.in_state(group))

    def in_state(self, group: tuple[int, ...]) -> tuple[int, ...]:
        """Return the entries of the state that these coordinates of a goal are."""
        return tuple(self.places[index] for index in group) if self.places else group

    def __call__(
        self, observation: Float[Array, "*#B S"], goal: Float[Array, "*#B G"]
    ) -> tuple[Float[Array, "*#B S"], Float[Array, "*#B I"]]:
        """Return what networks read of both; leading axes may be broadcast against each other.

        For a group at distance d from the state, with r what counts as near:
        the goal's coordinates, their difference Δ to the state's, Δ / (d + r), and log(d + r / 2).
        """
        if not self.groups:
            return observation, goal
        parts = [goal[..., jnp.asarray(group)] for group in self.groups]
        for group in self.groups if self.near else ():
            place = jnp.asarray(self.in_state(group))
            offset = goal[..., jnp.asarray(group)] - observation[..., place]
            distance = jnp.sqrt((offset**2).sum(-1, keepdims=True) + 1e-6)
            parts += [offset, offset / (distance + self.near), jnp.log(distance + self.near / 2)]
        leading = jnp.broadcast_shapes(*(part.shape[:-1] for part in parts))
        whole = [jnp.broadcast_to(part, (*leading, part.shape[-1])) for part in parts]
        return observation, jnp.concatenate(whole, axis=-1)

    def size(self, goal_size: int) -> int:
        """Return how many numbers are read of a goal."""
        if not self.groups:
            return goal_size
        relative = sum(2 * len(group) + 1 for group in self.groups) if self.near else 0
        return len(self.coordinates) + relative

    def pick(self, vector: Float[Array, "*B S"]) -> Float[Array, "*B C"]:
        """Return these coordinates of states; all entries where the whole goal is read."""
        return vector[..., jnp.asarray(self.coordinates)] if self.groups else vector

    def embed(
        self, observation: Float[Array, "*#B S"], coordinates: Float[Array, "*B C"]
    ) -> Float[Array, "*B P"]:
        """Return the states at these coordinates that else are as the observations."""
        if not self.groups:
            return coordinates
        shape = (*coordinates.shape[:-1], observation.shape[-1])
        whole = jnp.broadcast_to(observation, shape)
        return whole.at[..., jnp.asarray(self.coordinates)].set(coordinates)

    def spread(
        self, observation: Float[Array, "*B S"], scale: Float[Array, "*B C"]
    ) -> Float[Array, "*B P"]:
        """Return scales of whole states: 0 where `embed` takes the observation's entries."""
        return self.embed(jnp.zeros_like(observation), scale)


def create(spec: EnvSpec, inputs: GoalInputs, encoder: Encoder) -> PairInputs:
    """Return how networks read the goals of an environment.

    Goals are read whole where no state tells its own goal, or where success is not measured by
    distances between their coordinates.

    Args:
        spec: The environment.
        inputs: What the configuration asks for.
        encoder: What makes the features, for their units.
    """
    known = spec.goal_is_observation or spec.goal_coordinates
    if inputs == "whole" or not known or spec.state_shape is not None:
        return PairInputs()
    if not isinstance(spec.task, DistanceTask):
        return PairInputs()
    read = PairInputs(spec.task.groups, places=spec.goal_coordinates)
    if inputs == "coordinates":
        return read
    near = spec.task.threshold / encoders.scale(encoder, read.coordinates[0])
    return replace(read, near=near)
