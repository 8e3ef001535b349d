"""The command line: wires and prints."""

import dataclasses
import json
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from midway.cli.about import NOTHING, AboutEnv
from midway.cli.parsing import Count, OptionalCount, parse, plain, settings
from midway.errors import BrokenEnvironmentError, ConfigurationError, NonFiniteError
from midway.training.terminal import print_line

if TYPE_CHECKING:
    from midway.api import Run

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_SIGNAL = 128
"""To which the number of the signal that ended a run is added."""


def train(
    env: Positional[str],
    agent: str = "ris",
    preset: str = "quick",
    steps: OptionalCount = None,
    seed: int = 0,
    num_envs: OptionalCount = None,
    out: Path | None = None,
    precision: Literal["f32", "bf16"] | None = None,
    on_env_error: Literal["stop", "restart"] | None = None,
    data: str | None = None,
    set: tuple[str, ...] = (),
    about: AboutEnv = NOTHING,
) -> None:
    """Train an agent on an environment and write a run folder.

    Args:
        env: Environment name (see `midway envs`), a Gymnasium id, module:Id or module:callable.
        agent: ris, sac, crl, tdm or leap, or PACKAGE.MODULE:NAME for an agent of your own.
        preset: paper (table 1), quick (two cores), or a file ending in .toml.
        steps: Environment steps; default: the preset's.
        seed: The one seed of every generator.
        num_envs: Parallel environments; default: the preset's.
        out: Run folder; default: runs/ENV-AGENT-seedN.
        precision: Matrix products in float32 or bfloat16; default: the preset's.
        on_env_error: What a broken environment of others does: stop the run (default) or restart.
        data: Minari dataset (name or folder) that the replay begins with; with --set collect=False
            nothing else is learned from.
        set: Other settings of the preset, as NAME=VALUE.
        about: What midway must be told of an environment that is not its own.
    """
    from midway import api

    run = api.train(
        about.env(env),
        agent=agent,
        preset=preset,
        steps=steps,
        seed=seed,
        num_envs=num_envs,
        out=out,
        precision=precision,
        on_env_error=on_env_error,
        data=data,
        changes=settings(set),
        progress=True,
    )
    _say_where(run)


def check(
    env: Positional[str],
    num_envs: Count = 16,
    seconds: float = 15.0,
    about: AboutEnv = NOTHING,
) -> None:
    """Say what midway sees of a goal environment, and what is wrong with it.

    Args:
        env: Environment name, a Gymnasium id, module:Id or module:callable.
        num_envs: Environments that are stepped together to measure.
        seconds: How long random actions are taken, at most.
        about: What midway must be told of an environment that is not its own.
    """
    from midway.envs import examine

    findings = examine.examine(env, about.settings(), num_envs, seconds, **about.source())
    for label, text, _ in findings:
        print(f"{label:15} {text}")
    if not all(ok for _, _, ok in findings):
        sys.exit(EXIT_USAGE)


def resume(
    run: Positional[Path],
    steps: OptionalCount = None,
    devices: OptionalCount = None,
    from_: Annotated[OptionalCount, arg(name="from")] = None,
    on_env_error: Literal["stop", "restart"] | None = None,
) -> None:
    """Continue a run from its newest checkpoint.

    Args:
        run: Run folder.
        steps: New total of environment steps; default: the run's own.
        devices: New number of accelerators; default: the run's own.
        from_: Step of the checkpoint, 0 to start anew; later ones are renamed and kept.
        on_env_error: What a broken environment of others does from now on: stop the run or restart.
    """
    from midway import api

    given = {"steps": steps, "devices": devices, "from_step": from_}
    _say_where(api.resume(run, **given, on_env_error=on_env_error, progress=True))


def evaluate(
    run: Positional[Path],
    episodes: Count = 100,
    task: str | None = None,
    actions: Literal["mean", "sampled"] = "mean",
    seed: int = 0,
    json: bool = False,
) -> None:
    """Run episodes of a trained policy and print how many reach their goal.

    Args:
        run: Run folder.
        episodes: Number of episodes.
        task: hard, uniform, or a numbered case of the environment; default: hard, if there is one.
        actions: Mean or sampled actions.
        seed: Seed of starts and goals.
        json: Print one JSON object, with every episode.
    """
    from midway import api

    result = api.evaluate(run, episodes=episodes, task=task, actions=actions, seed=seed)
    if json:
        episodes_json = [dataclasses.asdict(episode) for episode in result.episodes]
        _print_json(
            {
                "run": str(run),
                "task": result.task,
                "actions": actions,
                "seed": seed,
                "success_rate": result.success_rate,
                "final_distance": result.final_distance,
                "episodes": episodes_json,
            }
        )
        return
    named = ", ".join(f"{name} {d:.3f} m" for name, d in result.final_distances.items())
    print(
        f"{run}: {result.task}, {actions} actions: success {result.success_rate:.1%} of {episodes} "
        f"episodes, {result.length:.1f} steps, {result.final_distance:.2f} m from the goal"
        + (f" ({named})" if named else "")
    )


def sweep(
    envs: Positional[tuple[str, ...]],
    agents: tuple[str, ...] = ("ris", "sac"),
    seeds: tuple[int, ...] = (0, 1, 2),
    preset: str = "quick",
    steps: OptionalCount = None,
    out: Path = Path("runs/sweep"),
    ray: str | None = None,
    set: tuple[str, ...] = (),
    about: AboutEnv = NOTHING,
) -> None:
    """Train every combination of environments, agents and seeds; typed again, it goes on.

    Args:
        envs: Environment names.
        agents: Agent names.
        seeds: Seeds.
        preset: paper or quick.
        steps: Environment steps of each run; default: the preset's.
        out: Folder of the run folders, which `midway report` takes as it is.
        ray: Address of a Ray cluster (auto: the one of this machine); default: this machine's
            cores, one run on each.
        set: Other settings of the preset, as NAME=VALUE.
        about: What midway must be told of environments that are not its own.
    """
    from rich.console import Console
    from rich.live import Live

    from midway import api
    from midway.cluster import sweep as sweeps
    from midway.cluster.jobs import check_settings

    if not (envs and agents and seeds):
        raise ConfigurationError("nothing to do: give environments, agents and seeds")
    changes = settings(set) | ({} if steps is None else {"steps": steps})
    for env in envs:
        for agent in agents:
            for seed in seeds:
                api.configure(about.env(env), agent, preset, seed, changes)
    options = ["--preset", preset, *about.options()]
    options += ["--set", *[f"{k}={v}" for k, v in changes.items()]] if changes else []
    wanted = sweeps.jobs(envs, agents, seeds, options)
    for job in wanted:
        check_settings(job, out, preset, changes)
    with Live(console=Console(stderr=True), refresh_per_second=1) as live:
        final = sweeps.run(wanted, out, lambda found: live.update(sweeps.table(found)), ray)
    if any(status.state in ("stopped", "waiting") for status in final):
        print_line(f"stopped; type the same command again to go on: {out}")
        sys.exit(EXIT_SIGNAL + signal.SIGINT)
    failed = [status.job.name for status in final if status.state != "finished"]
    if failed:
        raise OSError(f"{len(failed)} runs failed ({', '.join(failed)}): see their .log in {out}")
    print(f"finished {out}")


def report(runs: Positional[tuple[Path, ...]], out: Path | None = None) -> None:
    """Draw figures and one HTML page from run folders.

    Args:
        runs: Run folders, or the folder of a sweep.
        out: Folder for the figures; default: figures in the run folder, or report beside the first.
    """
    from midway import reports

    for path in reports.report(_run_folders(runs), out):
        print(path)


def watch(
    run: Positional[Path],
    out: Path | None = None,
    task: str | None = None,
    episodes: Count = 1,
    seed: int = 0,
    live: bool = False,
) -> None:
    """Write a video of the policy with its imagined subgoals, or show it in a window.

    Args:
        run: Run folder.
        out: The file, .mp4 or .gif; default: videos/TASK.mp4 in the run folder.
        task: hard, uniform, or a numbered case of the environment; default: hard, if there is one.
        episodes: Number of episodes.
        seed: Seed of starts and goals.
        live: Show the episodes in a window instead; needs a display.
    """
    from midway import reports

    if live:
        if out is not None:
            raise ConfigurationError(f"--out {out}: --live writes no file")
        reports.show(run, task=task, episodes=episodes, seed=seed)
        return
    print(reports.watch(run, out, task=task, episodes=episodes, seed=seed))


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
    results = {name: piece() for name, piece in chosen.items()}
    if json:
        _print_json({"machine": measure.machine(), "settings": of, **results})
        return
    print(", ".join(f"{name} {value}" for name, value in {**measure.machine(), **of}.items()))
    for name, figures in results.items():
        print(f"{name:8}" + "  ".join(f"{key} {value:.4g}" for key, value in figures.items()))


def envs(json: bool = False) -> None:
    """List the environments and their tasks.

    Args:
        json: Print one JSON object.
    """
    from midway.envs.registry import ENVIRONMENTS

    if json:
        entries = {
            name: {"id": e.gym_id, "tasks": list(e.tasks), "description": e.description}
            for name, e in ENVIRONMENTS.items()
        }
        _print_json(entries)
        return
    for name, entry in ENVIRONMENTS.items():
        print(f"{name:12} {entry.gym_id:26} {entry.description}")
        print(f"{'':12} tasks: {', '.join(entry.tasks)}")


def doctor(json: bool = False) -> None:
    """Say what this machine has and what is missing.

    Args:
        json: Print one JSON object.
    """
    from midway.cli.doctor import checks

    results = checks()
    if json:
        _print_json({check.name: dataclasses.asdict(check) for check in results})
    else:
        for check in results:
            print(f"{'ok     ' if check.ok else 'MISSING'} {check.name:12} {check.detail}")
    if not all(check.ok for check in results if check.needed):
        sys.exit(EXIT_FAILED)


def presets(
    env: Positional[str] = "ant-u",
    agent: Positional[str] = "ris",
    preset: str = "quick",
    set: tuple[str, ...] = (),
    json: bool = False,
) -> None:
    """Print every setting of a preset with its value and where that comes from.

    Args:
        env: Environment name.
        agent: Agent name.
        preset: paper, quick, or a file ending in .toml.
        set: Other settings of the preset, as NAME=VALUE.
        json: Print one JSON object.
    """
    from midway import presets as rules
    from midway import settings as declarations

    resolved = rules.resolve(env, agent, preset, settings(set))
    rows = [
        (name, value, resolved.sources.get(name, rules.Source("default of the agent")), allowed)
        for config in (resolved.train, resolved.hyperparameters)
        for name, value, allowed in declarations.declared(config)
    ]
    if json:
        _print_json(
            {name: {"value": plain(value), **source._asdict()} for name, value, source, _ in rows}
        )
        return
    for name, value, source, allowed in rows:
        mark = f" [not the paper's: {source.deviates}]" if source.deviates else ""
        print(f"{name:22} {plain(value)!s:22} {allowed.meaning:38} {source.source}{mark}".rstrip())


COMMANDS: dict[str, Callable[..., None]] = {
    "check": check,
    "train": train,
    "resume": resume,
    "sweep": sweep,
    "evaluate": evaluate,
    "report": report,
    "watch": watch,
    "bench": bench,
    "envs": envs,
    "presets": presets,
    "doctor": doctor,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit with 0, 1 (failed while running), 2 (wrong use) or 128 + a signal."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        command = parse(COMMANDS, arguments)
        from midway.training.compilation import use_compilation_cache

        use_compilation_cache()
        command()
    except ConfigurationError as error:
        _fail(EXIT_USAGE, error)
    except (NonFiniteError, BrokenEnvironmentError) as error:
        _fail(EXIT_FAILED, error)
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        _fail(EXIT_USAGE, error)
    except KeyboardInterrupt:
        _fail(EXIT_SIGNAL + signal.SIGINT, "interrupted")
    except BrokenPipeError:
        sys.stdout = None
        sys.exit(EXIT_FAILED)
    except (OSError, MemoryError) as error:
        _fail(EXIT_FAILED, _described(error))


def _described(error: OSError | MemoryError) -> str:
    """Return what the error says, its file first."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _fail(status: int, error: object) -> None:
    text = " ".join(str(error).split())
    print_line(f"midway: {text}")
    sys.exit(status)


def _run_folders(paths: Sequence[Path]) -> list[Path]:
    """Return the paths, with the folder of a sweep replaced by its runs."""
    found: list[Path] = []
    for path in paths:
        below = sorted(config.parent for config in path.glob("*/config.json"))
        found += below if below and not (path / "config.json").exists() else [path]
    return found


def _print_json(value: object) -> None:
    print(json.dumps(value))


def _say_where(run: "Run") -> None:
    state = "finished" if run.finished else "stopped; continue with: midway resume"
    with suppress(BrokenPipeError):  # whoever reads may have ended by the same signal
        print(f"{state} {run.path}", flush=True)
    if run.signal is not None:
        sys.exit(EXIT_SIGNAL + run.signal)
