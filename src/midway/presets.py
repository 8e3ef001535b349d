"""Values for each agent and environment: ``paper`` from table 1, ``quick`` for two cores.

Only what differs from a dataclass's own defaults (table 1, ant navigation) stands here.
"""

from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

from midway.agents import registry
from midway.training.config import TrainConfig
from midway.types import ConfigurationError

Preset: TypeAlias = Literal["paper", "quick"]


def preset(env: str, agent: str, name: str) -> tuple[TrainConfig, Any]:
    """Return the settings of the loop and of the agent.

    Args:
        env: Environment name.
        agent: Agent name.
        name: ``paper`` or ``quick``.

    Raises:
        ConfigurationError: The preset or the agent is unknown.
    """
    if name not in get_args(Preset):
        raise ConfigurationError(f"unknown preset {name!r}: choose one of paper, quick")
    config = registry.get(agent).Config()
    family = env.split("-")[0]
    if name == "paper":
        return _paper(family), config
    return QUICK.get(family, QUICK["point"]), replace(config, **_quick(family))


def _paper(family: str) -> TrainConfig:
    """Return table 1; the point mazes are not in the paper and take the ant's values."""
    return TrainConfig()


QUICK: dict[str, TrainConfig] = {
    "point": TrainConfig(
        steps=16_000,
        num_envs=8,
        random_steps=1_000,
        updates_per_step=1.0,
        batch_size=256,
        replay_capacity=200_000,
        evaluate_every=2_000,
        evaluation_episodes=100,
        log_every=500,
        checkpoint_every=8_000,
    ),
    "ant": TrainConfig(
        steps=300_000,
        num_envs=8,
        random_steps=5_000,
        updates_per_step=0.25,
        batch_size=1024,
        replay_capacity=500_000,
        evaluate_every=25_000,
        evaluation_episodes=20,
        log_every=2_000,
        checkpoint_every=25_000,
    ),
}


def _quick(family: str) -> dict[str, Any]:
    """Return what ``quick`` changes in the agent."""
    return {}
