"""Presets: an ordered table of rules; later ones win.

``paper`` is as published, ``quick`` is for two processor cores.

The defaults of the configurations are the paper's ant navigation and stand there, with their
sources. The rules say what differs by environment and agent.
"""

import fnmatch
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from midway import settings
from midway.agents import registry as agents
from midway.envs import registry as environments
from midway.envs.registry import Declaration
from midway.errors import ConfigurationError
from midway.networks.mlp import fastest_precision
from midway.plain import check_kinds
from midway.training.config import TrainConfig
from midway.types import Hyperparameters, RelabelMix

if TYPE_CHECKING:
    from midway.envs.describing import EnvLike

Values: TypeAlias = Mapping[str, object]


@dataclass(frozen=True)
class Rule:
    """Values for some presets, environments and agents.

    Attributes:
        preset: Name of the preset; ``*`` for each.
        values: Values by the names of the settings.
        source: Where they come from.
        env: Patterns of environment names, separated by spaces; a name without a pattern's
            wildcard is that environment alone.
        agent: Patterns of agent names, separated by spaces.
        family: Pattern of the environment's family; ``other`` for those that are not midway's.
        deviates: Why values of ``paper`` are not the paper's; nothing where they are.
    """

    preset: str
    values: Values
    source: str
    env: str = "*"
    agent: str = "*"
    family: str = "*"
    deviates: str = ""

    def applies(self, preset: str, env: Declaration, agent: str) -> bool:
        """Return whether the rule is one of this preset, environment and agent."""
        return (
            self.preset in ("*", preset)
            and any(fnmatch.fnmatchcase(env.name, pattern) for pattern in self.env.split())
            and any(fnmatch.fnmatchcase(agent, pattern) for pattern in self.agent.split())
            and fnmatch.fnmatchcase(env.family, self.family)
        )


class Source(NamedTuple):
    """Where a value comes from, and why it is not the paper's if it should be."""

    source: str
    deviates: str = ""


class Resolved(NamedTuple):
    """What a preset says of an environment and an agent.

    Attributes:
        train: Settings of the loop.
        hyperparameters: The agent's configuration.
        sources: Where each value comes from, by its name.
    """

    train: TrainConfig
    hyperparameters: Hyperparameters
    sources: dict[str, Source]


HINDSIGHT_OF_LEAP = RelabelMix(own=0.4, random=0.2, future=0.4)
DISCOUNTED_FUTURE = RelabelMix(own=0.0, random=0.0, future=1.0, future_discount=0.99)

PAPER: tuple[Rule, ...] = (
    Rule(
        "*",
        {"policy_learning_rate": 1e-4, "epsilon": 1e-4},
        "table 1",
        env="push push-state",
        agent="ris",
    ),
    Rule(
        "*",
        {"policy_learning_rate": 1e-4, "entropy_learning_rate": 1e-4},
        "table 1",
        env="push push-state",
        agent="sac",
    ),
    Rule(
        "*",
        {"batch_size": 256, "replay_capacity": 102_000},
        "table 1: 100,000 transitions in episodes of 100",
        env="push push-state",
    ),
    Rule("paper", {"random_steps": 3_000}, "code of LEAP: the first update", agent="tdm leap"),
    Rule("paper", {"batch_size": 2_048}, "code of LEAP", env="push push-state", agent="tdm leap"),
    Rule(
        "paper",
        {"evaluate_every": 250_000},
        "ours",
        agent="leap",
        deviates="an episode of the ant is 11 plans",
    ),
    Rule("*", {"num_rewards": 17}, "code of LEAP: positions", env="ant-*", agent="tdm leap"),
    Rule("*", {"max_steps_left": 75}, "table 2", env="ant-pi", agent="tdm leap"),
    Rule("*", {"max_steps_left": 100}, "table 2", env="ant-omega", agent="tdm leap"),
    Rule("*", {"max_steps_left": 25}, "table 2", env="push push-state", agent="tdm leap"),
    Rule(
        "*",
        {"num_rewards": 4, "saturation_weight": 0.0},
        "code of LEAP: hand and puck",
        env="push push-state",
        agent="tdm leap",
    ),
    Rule("*", {"num_subgoals": 3}, "table 2", env="push push-state", agent="leap"),
    Rule("*", {"latent_size": 16}, "appendix D", env="push push-state", agent="leap"),
    Rule(
        "*",
        {
            "vae_kl_weight": 2.5,
            "vae_random_actions": 4,
            "plan_samples": 1_000,
            "plan_iterations": 15,
            "plan_elites": (0.05,),
            "prior_weight": 1e-3,
        },
        "code of LEAP",
        env="push push-state",
        agent="leap",
    ),
    Rule(
        "*",
        {"max_steps_left": 14, "num_rewards": 2},
        "leap.md",
        env="point-*",
        agent="tdm leap",
        deviates="point mazes are not in the paper",
    ),
    Rule(
        "*",
        {"num_subgoals": 9, "latent_size": 2, "vae_kl_weight": 1e-3},
        "leap.md",
        env="point-*",
        agent="leap",
        deviates="point mazes are not in the paper",
    ),
    Rule(
        "*",
        {"vae_kl_weight": 1e-3},
        "leap.md",
        env="push-state",
        agent="leap",
        deviates="2.5 is the weight for 21,168 pixels; of four numbers it leaves nothing",
    ),
    Rule(
        "paper",
        {"evaluation_episodes": 100},
        "ours: steps are cheap",
        env="point-*",
        deviates="point mazes are not in the paper",
    ),
    Rule("*", {"relabel": DISCOUNTED_FUTURE}, "CRL", agent="crl"),
)
"""What the paper says of other tasks than ant navigation; ``quick`` begins with it."""

QUICK: tuple[Rule, ...] = (
    Rule(
        "quick",
        {
            "num_envs": 16,
            "random_steps": 1_000,
            "updates_per_step": 0.5,
            "batch_size": 256,
            "replay_capacity": 200_000,
            "evaluate_every": 4_000,
            "evaluation_episodes": 100,
            "log_every": 1_000,
            "checkpoint_every": 16_000,
        },
        "curves of the point mazes: steps are cheap there, and fresh ones help",
    ),
    Rule(
        "quick",
        {
            "num_envs": 8,
            "random_steps": 10_000,
            "updates_per_step": 1.0,
            "replay_capacity": 500_000,
            "evaluate_every": 25_000,
            "evaluation_episodes": 20,
            "log_every": 2_000,
            "checkpoint_every": 25_000,
        },
        "curves of ant-u: many small batches",
        env="ant-*",
    ),
    Rule(
        "quick",
        {
            "num_envs": 16,
            "updates_per_step": 0.5,
            "collect_limit": 300,
            "evaluate_every": 16_000,
            "checkpoint_every": 48_000,
        },
        "trials of ant-u: steps are cheaper than updates",
        env="ant-*",
        agent="ris sac tdm leap",
    ),
    Rule(
        "quick",
        {
            "n_step": 5,
            "clip_targets": True,
            "unreached_goals": True,
            "num_critics": 1,
            "layer_norm": True,
            "normalise": True,
            "goal_inputs": "relative",
            "policy_every": 2,
        },
        "trials of ant-u: beyond the paper",
        env="ant-*",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"discount": 0.995},
        "trials of ant-pi: of 500 steps 0.99 leaves less than 1 %",
        env="ant-*",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {
            "steps": 50_000,
            "n_step": 3,
            "clip_targets": True,
            "unreached_goals": True,
            "layer_norm": True,
            "normalise": True,
            "goal_inputs": "relative",
        },
        "as on ant-u, seen on PandaReach and PointMaze: units are not known",
        family="other",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"advantage_temperature": 2.0, "subgoal_learning_rate": 1e-3},
        "as on ant-u, seen on PandaReach and PointMaze",
        family="other",
        agent="ris",
    ),
    Rule(
        "quick",
        {"num_subgoals": 4, "subgoal_every": 4},
        "trials of ant-u: beyond the paper",
        env="ant-*",
        agent="ris",
    ),
    Rule(
        "quick",
        {"kl_weight": 0.2, "advantage_temperature": 4.0, "subgoal_learning_rate": 1e-3},
        "trials of ant-pi: values are twice as large, and subgoals came late",
        env="ant-*",
        agent="ris",
    ),
    Rule(
        "quick",
        {"halve_rates_after": 50_000},
        "trials of ant-pi: with fixed rates success comes and goes",
        env="ant-pi",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"halve_rates_after": 150_000},
        "trials of ant-omega: with 50,000 success comes later and does not stay",
        env="ant-omega",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {
            "num_envs": 8,
            "random_steps": 10_000,
            "updates_per_step": 0.25,
            "encoder_batch_size": 64,
            "replay_capacity": 102_000,
            "evaluate_every": 30_000,
            "evaluation_episodes": 50,
            "log_every": 2_000,
            "checkpoint_every": 30_000,
            "task": "near",
        },
        "trials of push: hands that start beside the puck push it now and then",
        env="push push-state",
    ),
    Rule(
        "quick",
        {
            "random_steps": 5_000,
            "updates_per_step": 1.0,
            "evaluate_every": 10_000,
            "evaluation_episodes": 100,
            "checkpoint_every": 20_000,
        },
        "curves of push-state",
        env="push-state",
    ),
    Rule(
        "quick",
        {"freeze_encoder_after": 15_000},
        "trials of push: policies improve once features stay what they are",
        env="push",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"policy_learning_rate": 1e-3, "encoder_learning_rate": 3e-4, "random_shift": 2},
        "trials of push: with shifts of 4 pixels one seed of three learned nothing",
        env="push push-state",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {
            "clip_targets": True,
            "unreached_goals": True,
            "layer_norm": True,
            "policy_every": 2,
        },
        "as on ant-u, seen on push-state",
        env="push-state",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"num_envs": 16, "updates_per_step": 0.5, "goal_inputs": "relative"},
        "trials of push-state: fewer updates, steps are cheap",
        env="push-state",
        agent="ris sac",
    ),
    Rule(
        "quick",
        {"advantage_temperature": 2.0},
        "trials of push: with 0.1 one candidate has nearly all the weight",
        env="push push-state",
        agent="ris",
    ),
    Rule(
        "quick",
        {"num_subgoals": 4, "subgoal_every": 4},
        "as on ant-u, seen on push-state",
        env="push-state",
        agent="ris",
    ),
    Rule(
        "quick",
        {"subgoal_learning_rate": 1e-3},
        "curves of the point mazes: fewer updates than the paper",
        env="point-*",
        agent="ris",
    ),
    Rule("quick", {"relabel": HINDSIGHT_OF_LEAP}, "code of LEAP", agent="tdm leap"),
    Rule("quick", {"evaluate_every": 16_000}, "leap.md: evaluations plan", agent="leap"),
    Rule("quick", {"evaluate_every": 160_000}, "leap.md", env="ant-* push", agent="leap"),
    Rule("quick", {"evaluate_every": 8_000}, "leap.md", env="point-*", agent="leap"),
    Rule(
        "quick",
        {"vae_rounds": 300, "plan_samples": 1_000, "plan_iterations": 20},
        "leap.md",
        agent="leap",
    ),
    Rule(
        "quick",
        {
            "vae_states": 10_000,
            "vae_rounds": 30,
            "plan_samples": 300,
            "plan_iterations": 10,
            "evaluation_episodes": 30,
        },
        "leap.md",
        env="push push-state",
        agent="leap",
    ),
    Rule(
        "quick",
        {
            "updates_per_step": 1.0,
            "plan_samples": 150,
            "plan_iterations": 8,
            "evaluation_episodes": 20,
        },
        "leap.md",
        env="push",
        agent="leap",
    ),
    Rule(
        "quick",
        {"hidden": (256, 256), "target_update_rate": 0.02},
        "leap.md",
        env="point-*",
        agent="tdm leap",
    ),
    Rule(
        "quick",
        {"vae_states": 5_000, "vae_rounds": 100, "plan_samples": 256, "plan_iterations": 15},
        "leap.md",
        env="point-*",
        agent="leap",
    ),
)
"""What two processor cores change."""

RULES = (*PAPER, *QUICK)
NAMES = ("paper", "quick")


def resolve(
    env: "EnvLike | Declaration", agent: str, preset: str = "quick", changes: Values | None = None
) -> Resolved:
    """Return the settings of a preset for an environment and an agent.

    Args:
        env: Environment name, its declaration, or another environment.
        agent: Agent name.
        preset: ``paper``, ``quick``, or the path of a preset file.
        changes: Values that win over the preset's.

    Raises:
        ConfigurationError: A name is unknown, or a value is not allowed.
    """
    declaration = environments.entry(env)
    config = agents.get(agent).Config
    base, rules = _rules(preset)
    train, hyperparameters = TrainConfig(), config()
    sources = {
        name: Source(allowed.source, allowed.deviates)
        for settled in (train, hyperparameters)
        for name, _, allowed in settings.declared(settled)
    }
    sources["relabel"] = Source("appendix B")
    chosen = [rule for rule in rules if rule.applies(base, declaration, agent)]
    if base == "quick":
        chosen = [*_of_this_machine(declaration, sources), *chosen]
    given = Rule("*", changes or {}, "given")
    values: dict[str, object] = {}
    for rule in (*chosen, given):
        values |= rule.values
        sources |= dict.fromkeys(rule.values, Source(rule.source, rule.deviates))
    # All at once: two values may fit each other, and one alone not the default.
    parts = settings.split(values, (train, hyperparameters))
    train = settings.changed(train, parts[0])
    return Resolved(train, settings.changed(hyperparameters, parts[1]), sources)


def _of_this_machine(env: Declaration, known: Iterable[str]) -> list[Rule]:
    """Return what `quick` takes from the environment's declaration and from the processor."""
    rules = [Rule("quick", {"steps": env.steps}, "declaration of the environment")]
    if "precision" in known:
        fastest = {"precision": fastest_precision()}
        rules.append(Rule("quick", fastest, "this machine's fastest"))
    return rules


def _rules(preset: str) -> tuple[str, Sequence[Rule]]:
    """Return the name of a preset, that of its base for a file, and all rules that may apply."""
    if preset in NAMES:
        return preset, RULES
    if not preset.endswith(".toml"):
        raise ConfigurationError(
            f"unknown preset {preset!r}: choose one of {', '.join(NAMES)}, or a .toml file"
        )
    return _read(Path(preset))


def _read(path: Path) -> tuple[str, Sequence[Rule]]:
    """Return the base of a preset file, and the base's rules with those of the file after them.

    Raises:
        ConfigurationError: The file cannot be read or holds something else.
    """
    try:
        content = tomllib.loads(path.read_text())
        base = content.pop("base", "quick")
        given = content.pop("rule", [])
        rules = [Rule("*", **{"source": path.name, **rule}) for rule in given]
        for rule in rules:
            check_kinds(rule)
    except (OSError, ValueError, RecursionError) as error:  # no TOML, absurd numbers or depth
        raise ConfigurationError(f"preset {path}: {error}") from error
    except (TypeError, AttributeError):
        raise ConfigurationError(
            f"preset {path}: a [[rule]] has values, and may have env, agent, family and source"
        ) from None
    if base not in NAMES or content:
        unknown = ", ".join(content) or f"base {base!r}"
        raise ConfigurationError(
            f"preset {path}: {unknown} not understood: it has base (paper or quick) and [[rule]]"
        )
    return base, (*RULES, *rules)
