"""The agents by the names that users type."""

from types import ModuleType

from midway.agents import leap, ris, sac, tdm
from midway.types import ConfigurationError

AGENTS: dict[str, ModuleType] = {"ris": ris, "sac": sac, "tdm": tdm, "leap": leap}
"""Each module is a `midway.types.Agent` with its ``Config``, ``State`` and ``NETWORKS``."""


def get(name: str) -> ModuleType:
    """Return the agent's module.

    Raises:
        ConfigurationError: No agent has this name.
    """
    if name not in AGENTS:
        raise ConfigurationError(f"unknown agent {name!r}: choose one of {', '.join(AGENTS)}")
    return AGENTS[name]
