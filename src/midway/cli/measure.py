"""Commands that look at an environment, and at how fast the machine is."""

import sys
from collections.abc import Callable
from typing import Literal

from tyro.conf import Positional

from midway.cli.about import NOTHING, AboutEnv
from midway.cli.parsing import Count, print_json

EXIT_USAGE = 2


def check(
    env: Positional[str],
    num_envs: Count = 16,
    seconds: float = 15.0,
    about: AboutEnv = NOTHING,
) -> None:
    """Say what midway sees of an environment, and what is wrong with it.

    Args:
        env: Environment name, a Gymnasium id, module:Id or module:callable.
        num_envs: Environments that are stepped together to measure.
        seconds: How long random actions are taken, at most.
        about: What midway must be told of an environment that is not its own.
    """
    from midway.envs import examine
    from midway.envs.registry import ENVIRONMENTS

    own = about.maze is not None or env in ENVIRONMENTS
    seen = about.env(env) if own else env
    findings = examine.examine(seen, about.settings(), num_envs, seconds, **about.source())
    for label, text, _ in findings:
        print(f"{label:15} {text}")
    if not all(ok for _, _, ok in findings):
        sys.exit(EXIT_USAGE)


def bench(
    what: Positional[Literal["all", "update", "env", "replay", "loop", "memory", "plan"]] = "all",
    env: str = "ant-u",
    agent: str = "ris",
    batch: Count = 256,
    precision: Literal["f32", "bf16"] = "f32",
    num_envs: Count = 64,
    json: bool = False,
) -> None:
    """Measure how fast this machine updates, simulates, stores and plans, and what memory it takes.

    Args:
        what: One piece, or all of them.
        env: Environment name.
        agent: Agent name.
        batch: Transitions of one update.
        precision: Matrix products in float32 or bfloat16.
        num_envs: Environments that are stepped together in env.
        json: Print one JSON object.
    """
    from midway.bench import pieces as measure
    from midway.bench import plan as bench_plan
    from midway.training.progress import stage

    pieces: dict[str, Callable[[], measure.Figures]] = {
        "update": lambda: measure.update(env, agent, batch, precision),
        "env": lambda: measure.environment(env, num_envs),
        "replay": lambda: measure.replay(env, batch),
        "loop": lambda: measure.whole_loop(env, agent, batch, precision),
        "memory": lambda: measure.memory(env, agent, batch, precision),
        "plan": lambda: bench_plan.plan(env, precision),
    }
    chosen = pieces if what == "all" else {what: pieces[what]}
    of = {"env": env, "agent": agent, "batch": batch, "precision": precision, "num_envs": num_envs}
    results = {}
    for number, (name, piece) in enumerate(chosen.items()):
        stage(f"bench {name}", number, len(chosen))
        results[name] = piece()
    if json:
        print_json({"machine": measure.machine(), "settings": of, **results})
        return
    print(", ".join(f"{name} {value}" for name, value in {**measure.machine(), **of}.items()))
    for name, figures in results.items():
        print(f"{name:8}" + "  ".join(f"{key} {value:.4g}" for key, value in figures.items()))
