"""Values for each agent and environment: ``paper`` as published, ``quick`` for two cores.

Sources: [1] table 1, [2] table 2, [B] appendix B, [D] appendix D, [code] the original code of RIS
where the paper is silent, [LEAP] that of LEAP, [curves] measured here with ``benchmarks/run.py``,
[leap.md] measured here, see ``docs/algorithms/leap.md``, [trials] single runs, see
``benchmarks/README.md``.
"""

from dataclasses import fields, replace
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
LEAP_PAPER: dict[str, Any] = {
    "hidden": (400, 300),  # [D]
    "max_steps_left": 50,  # [2]
    "reward_scale": 10.0,  # [LEAP]
    "target_update_rate": 5e-3,  # [LEAP]
    "policy_delay": 2,  # [LEAP]
    "critic_learning_rate": 1e-3,  # [LEAP]
    "policy_learning_rate": 1e-3,  # [LEAP]
    "encoder_learning_rate": 1e-4,  # of RIS; for tdm on images
    "target_noise": 0.2,  # [LEAP]
    "target_noise_bound": 0.5,  # [LEAP]
    "saturation_weight": 1.0,  # [LEAP] ant
    "saturation_bound": 20.0,  # [LEAP] ant
    "exploration_noise": 0.3,  # [LEAP] σ
    "exploration_reversion": 0.15,  # [LEAP] θ
    "num_subgoals": 11,  # [2]
    "latent_size": 8,  # [D] ant
    "vae_hidden": (64, 128, 64),  # [D]
    "vae_kl_weight": 1e-4,  # [leap.md] [LEAP] has 1e-2, which loses the position
    "vae_learning_rate": 1e-3,  # [LEAP]
    "vae_states": 50_000,  # [LEAP]
    "vae_random_actions": 0,  # [leap.md] [LEAP] has 1, which loses the position
    "vae_rounds": 2_500,  # [LEAP]
    "vae_updates": 100,  # [LEAP]
    "vae_batch_size": 128,  # [LEAP]
    "plan_samples": 10_000,  # [LEAP] ant
    "plan_iterations": 50,  # [LEAP] ant
    "plan_elites": (0.25, 0.01),  # [LEAP] ant
    "plan_std": 1.5,  # [LEAP]
    "prior_weight": 0.1,  # [LEAP] ant
}
"""LEAP, and TDM as far as it has these."""

PUSH_PAPER: dict[str, Any] = {
    "policy_learning_rate": 1e-4,  # [1]
    "entropy_learning_rate": 1e-4,  # as the policy's
    "epsilon": 1e-4,  # [1] ε
}
"""What differs on the arm and puck, for ``ris`` and ``sac``."""

HYPERPARAMETERS = {"ris": RIS_PAPER, "sac": SAC_PAPER, "tdm": LEAP_PAPER, "leap": LEAP_PAPER}

LEAP_TASKS: dict[str, dict[str, Any]] = {
    "ant": {"num_rewards": 17},  # [LEAP] positions
    "ant-pi": {"max_steps_left": 75},  # [2]
    "ant-omega": {"max_steps_left": 100},  # [2]
    "push": {
        "max_steps_left": 25,  # [2]
        "num_rewards": 4,  # [LEAP] hand and puck
        "saturation_weight": 0.0,  # [LEAP]
        "num_subgoals": 3,  # [2]
        "latent_size": 16,  # [D]
        "vae_kl_weight": 2.5,  # [LEAP]
        "vae_random_actions": 4,  # [LEAP]
        "plan_samples": 1_000,  # [LEAP]
        "plan_iterations": 15,  # [LEAP]
        "plan_elites": (0.05,),  # [LEAP]
        "prior_weight": 1e-3,  # [LEAP]
    },
    "point": {  # not in the paper: [leap.md]
        "max_steps_left": 14,
        "num_rewards": 2,
        "num_subgoals": 9,
        "latent_size": 2,
        "vae_kl_weight": 1e-3,
    },
}
"""What differs by family of environments or environment, for ``tdm`` and ``leap``."""

LEAP_LOOP: dict[str, Any] = {
    "random_steps": 3_000,  # [LEAP] the first update
    "relabel": RelabelMix(own=0.4, random=0.2, future=0.4),  # [LEAP] own and fresh goals as one
}
PAPER_LOOPS: dict[str, dict[str, Any]] = {
    "tdm": LEAP_LOOP,
    "leap": LEAP_LOOP | {"evaluate_every": 250_000},  # an episode of the ant is 11 plans
}
"""What differs in the loop by agent."""

PUSH_LOOP: dict[str, Any] = {
    "batch_size": 256,  # [1]
    "replay_capacity": 102_000,  # [1] 100,000 transitions in episodes of 100
}
"""What differs in the loop on the arm and puck; [LEAP] has 2,048 and a million, on states."""

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
        steps=300_000,  # [curves] RIS solves the U-shaped maze, in about 75 minutes
        num_envs=8,
        updates_per_step=1.0,  # [curves] many small batches
        batch_size=256,
        replay_capacity=500_000,
        evaluate_every=25_000,
        log_every=2_000,
        checkpoint_every=25_000,
    ),
}
QUICK["point-omega"] = replace(QUICK["point"], steps=48_000)  # [curves] the longest way
QUICK["push"] = replace(
    PAPER,
    steps=400_000,  # [curves]
    num_envs=8,
    updates_per_step=0.25,  # [trials] steps are cheaper than updates, and each shows new images
    batch_size=256,
    encoder_batch_size=64,  # [trials] images take most of the time
    replay_capacity=102_000,
    evaluate_every=30_000,
    evaluation_episodes=50,
    log_every=2_000,
    checkpoint_every=30_000,
    task="near",  # [code] hands that start beside the puck push it now and then
)
QUICK["push-state"] = replace(
    QUICK["push"],
    steps=60_000,  # [curves]
    random_steps=5_000,
    updates_per_step=1.0,
    evaluate_every=10_000,
    checkpoint_every=20_000,
)
"""The loop by environment or family of environments; others take the point's."""

PUSH_QUICK: dict[str, Any] = {
    "policy_learning_rate": 1e-3,  # [curves] the ant's
    "encoder_learning_rate": 3e-4,
    "encoder_updates": 15_000,  # [trials] policies improve once codes stay what they are
    "image_translation": 4,  # [trials] 8 are 5.7 cm, more than a goal may be missed by
}
LEAP_QUICK = {"vae_rounds": 300, "plan_samples": 1_000, "plan_iterations": 20}  # [leap.md]
LEAP_QUICK_POINT: dict[str, Any] = {  # [leap.md]
    "hidden": (256, 256),
    "target_update_rate": 0.02,
    "vae_states": 5_000,
    "vae_rounds": 100,
    "plan_samples": 256,
    "plan_iterations": 15,
}
QUICK_HYPERPARAMETERS: dict[tuple[str, str], dict[str, Any]] = {
    ("point", "ris"): {"subgoal_learning_rate": 1e-3},  # [curves] fewer updates than the paper
    ("push", "ris"): PUSH_QUICK,
    ("push", "sac"): PUSH_QUICK,
    ("any", "leap"): LEAP_QUICK,
    ("push", "leap"): {
        "vae_states": 10_000,
        "vae_rounds": 30,
        "plan_samples": 300,
        "plan_iterations": 10,
    },
    ("point", "tdm"): LEAP_QUICK_POINT,
    ("point", "leap"): LEAP_QUICK_POINT,
}
"""What ``quick`` changes in an agent, by family of environments and agent."""

QUICK_LOOPS: dict[tuple[str, str], dict[str, Any]] = {
    ("any", "tdm"): {"relabel": LEAP_LOOP["relabel"]},
    ("any", "leap"): {"relabel": LEAP_LOOP["relabel"], "evaluate_every": 16_000},
    ("ant", "leap"): {"evaluate_every": 75_000},
    ("push", "leap"): {"evaluation_episodes": 30},  # [LEAP]
    ("point", "leap"): {"evaluate_every": 8_000},
}
"""What ``quick`` changes in the loop, by family of environments and agent."""


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
    config, family = registry.get(agent).Config, env.partition("-")[0]
    values = HYPERPARAMETERS[agent]
    tasks = LEAP_TASKS if agent in ("tdm", "leap") else {"push": PUSH_PAPER}
    values = values | tasks.get(family, {}) | tasks.get(env, {})
    if name == "paper":
        loop = PAPER_LOOPS.get(agent, {}) | (PUSH_LOOP if family == "push" else {})
        return replace(PAPER, **loop), config(**_known(config, values))
    train = QUICK.get(env) or QUICK.get(family, QUICK["point"])
    for key in (("any", agent), (family, agent)):
        train = replace(train, **QUICK_LOOPS.get(key, {}))
        values = values | QUICK_HYPERPARAMETERS.get(key, {})
    return train, config(**_known(config, values), precision=fastest_precision())


def _known(config: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values that the configuration has a field for."""
    names = {field.name for field in fields(config)}
    return {name: value for name, value in values.items() if name in names}
