"""Values for each agent and environment: ``paper`` as published, ``quick`` for two cores.

Sources: [1] table 1, [B] appendix B, [D] appendix D, [code] the original implementation where the
paper is silent, [curves] measured here with ``benchmarks/run.py``.
"""

from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

from midway.agents import registry
from midway.networks.mlp import fastest_precision
from midway.training.config import TrainConfig
from midway.types import ConfigurationError, RelabelMix

PresetName: TypeAlias = Literal["paper", "quick"]

PAPER = TrainConfig(
    steps=1_000_000,  # [D]
    num_envs=1,  # [code]
    random_steps=10_000,  # [code]
    updates_per_step=1.0,  # [1]
    batch_size=2048,  # [1]
    replay_capacity=1_000_000,  # [1]
    relabel=RelabelMix(own=0.2, random=0.4, future=0.4),  # [B]
    evaluate_every=10_000,
    evaluation_episodes=20,  # [code] has 5, too few to tell curves apart
    log_every=1_000,
    checkpoint_every=50_000,
)
"""The loop of ant navigation. The point mazes are not in the paper and take the same values."""

RIS_PAPER: dict[str, Any] = {
    "hidden": (256, 256),  # [1]
    "discount": 0.99,  # [1] γ
    "target_update_rate": 5e-3,  # [1] τ
    "critic_learning_rate": 1e-3,  # [1]
    "policy_learning_rate": 1e-3,  # [1]
    "subgoal_learning_rate": 1e-4,  # [1]
    "encoder_learning_rate": 1e-4,  # [code]
    "kl_weight": 0.1,  # [1] α
    "advantage_temperature": 0.1,  # [1] λ
    "num_subgoals": 10,  # [B] I
    "epsilon": 1e-16,  # [1] ε
}
SAC_PAPER: dict[str, Any] = {
    "hidden": (256, 256),  # [1]
    "discount": 0.99,  # [1] γ
    "target_update_rate": 5e-3,  # [1] τ
    "critic_learning_rate": 1e-3,  # [1]
    "policy_learning_rate": 1e-3,  # [1]
    "entropy_learning_rate": 1e-3,  # as the policy's
    "encoder_learning_rate": 1e-4,  # [code] of RIS
}
HYPERPARAMETERS = {"ris": RIS_PAPER, "sac": SAC_PAPER, "tdm": {}, "leap": {}}

QUICK = {
    "point": replace(
        PAPER,
        steps=32_000,  # [curves]
        num_envs=16,
        random_steps=1_000,
        updates_per_step=0.5,  # [curves] steps are cheap here, and fresh ones help
        batch_size=256,  # [curves]
        replay_capacity=200_000,
        evaluate_every=4_000,
        evaluation_episodes=100,
        log_every=1_000,
        checkpoint_every=16_000,
    ),
    "ant": replace(
        PAPER,
        steps=300_000,
        num_envs=8,
        random_steps=5_000,
        updates_per_step=0.25,
        batch_size=1024,
        replay_capacity=500_000,
        evaluate_every=25_000,
        log_every=2_000,
        checkpoint_every=25_000,
    ),
}
QUICK["point-omega"] = replace(QUICK["point"], steps=48_000)  # [curves] the longest way
"""The loop by environment or family of environments; others take the point's."""

QUICK_HYPERPARAMETERS: dict[tuple[str, str], dict[str, Any]] = {
    ("point", "ris"): {"subgoal_learning_rate": 1e-3},  # [curves] fewer updates than the paper
}
"""What ``quick`` changes in an agent, by family of environments and agent."""


def preset(env: str, agent: str, name: str) -> tuple[TrainConfig, Any]:
    """Return the settings of the loop and of the agent.

    Args:
        env: Environment name.
        agent: Agent name.
        name: ``paper`` or ``quick``.

    Raises:
        ConfigurationError: The preset or the agent is unknown.
    """
    if name not in get_args(PresetName):
        raise ConfigurationError(f"unknown preset {name!r}: choose one of paper, quick")
    config = registry.get(agent).Config
    values = HYPERPARAMETERS[agent]
    if name == "paper":
        return PAPER, config(**values)
    family = env.partition("-")[0]
    changes = QUICK_HYPERPARAMETERS.get((family, agent), {})
    train = QUICK.get(env) or QUICK.get(family, QUICK["point"])
    return train, config(**{**values, **changes, "precision": fastest_precision()})
