"""An agent that is not midway's, as a file of another package would define it."""

from typing import Any

from jaxtyping import Array, Key

from midway.agent import Agent
from midway.agents import sac
from midway.types import EnvSpec


def create(config: sac.Config, spec: EnvSpec, key: Key[Array, ""]) -> Any:
    """Return what SAC begins with."""
    return sac.create(config, spec, key)


AGENT = Agent(sac.Config, create, sac.update, sac.act, networks=sac.AGENT.networks)
