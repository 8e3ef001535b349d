"""From observations to the codes that policies and critics read."""

import equinox as eqx
from jaxtyping import Array, Float, Key

from midway.types import EnvSpec


class StateEncoder(eqx.Module):
    """The identity: a state is its own code."""

    def __call__(self, observation: Float[Array, "B S"]) -> Float[Array, "B S"]:
        """Return the observation."""
        return observation

    def augment(self, observation: Float[Array, "B S"], key: Key[Array, ""]) -> Float[Array, "B S"]:
        """Return the observation: states are not augmented."""
        return observation


def create(spec: EnvSpec, key: Key[Array, ""]) -> StateEncoder:
    """Return the encoder that suits the environment's observations."""
    return StateEncoder()


def code_sizes(spec: EnvSpec) -> tuple[int, int]:
    """Return the sizes of an observation's and a goal's code."""
    return spec.observation_shape[0], spec.goal_shape[0]
