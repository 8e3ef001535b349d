"""The agents by the names that users type."""

import importlib

from midway.agent import Agent, AnyAgent
from midway.agents import crl, leap, ris, sac, tdm
from midway.types import ConfigurationError

AGENTS: dict[str, AnyAgent] = {
    "ris": ris.AGENT,
    "sac": sac.AGENT,
    "tdm": tdm.AGENT,
    "leap": leap.AGENT,
    "crl": crl.AGENT,
}
"""Every agent of this package."""


def get(name: str) -> AnyAgent:
    """Return the agent of a name of this package, or of ``package.module:NAME``.

    Raises:
        ConfigurationError: There is no such agent, or its module cannot be imported.
    """
    if name in AGENTS:
        return AGENTS[name]
    module, colon, attribute = name.partition(":")
    if not colon:
        raise ConfigurationError(
            f"unknown agent {name!r}: choose one of {', '.join(AGENTS)}, or package.module:NAME"
        )
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigurationError(f"agent {name}: {error}") from error
    if not isinstance(found, Agent):
        raise ConfigurationError(f"agent {name}: is a {type(found).__name__}, not a midway Agent")
    return found


def name_of(agent: str | AnyAgent) -> str:
    """Return the name that `get` finds an agent by.

    Raises:
        ConfigurationError: It is no top-level name of the module that defines its ``create``.
    """
    if isinstance(agent, str):
        return agent
    for name, known in AGENTS.items():
        if known is agent:
            return name
    module = importlib.import_module(agent.create.__module__)
    for attribute, found in vars(module).items():
        if found is agent:
            return f"{module.__name__}:{attribute}"
    raise ConfigurationError(
        f"the agent is no top-level name of {module.__name__}, so a run folder cannot name it"
    )
