"""The command line: wires and prints."""

import dataclasses
import importlib.metadata
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from midway.cli.about import NOTHING, AboutEnv
from midway.cli.compare import compare
from midway.cli.lists import doctor, envs, presets, runs
from midway.cli.measure import bench, check
from midway.cli.parsing import (
    Changes,
    Count,
    Kept,
    OptionalCount,
    parse,
    print_json,
    run_folders,
    settings,
)
from midway.cli.saved import export, pull, push
from midway.cli.tuning import tune
from midway.errors import BrokenEnvironmentError, ConfigurationError, NonFiniteError
from midway.training import signals
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
    stop_at: float | None = None,
    overwrite: bool = False,
    wandb: str | None = None,
    set: Changes = (),
    about: AboutEnv = NOTHING,
) -> None:
    """Train an agent on an environment and write a run folder.

    Every setting with its value and source: midway presets ENV AGENT --preset PRESET

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
        stop_at: Success of the task that is shown (hard, if there is one) that ends the run once
            three evaluations in a row have reached it, such as 0.95.
        overwrite: Delete the run that is in the folder, unless another process trains it.
        wandb: Project of Weights & Biases that is shown the run too.
        set: Other settings of the preset, as NAME=VALUE.
        about: What midway must be told of an environment that is not its own.
    """
    from midway import api
    from midway.envs import registry as environments
    from midway.runs.folder import run_name
    from midway.runs.tracking import watching

    declared = environments.entry(about.env(env))
    out = out or Path("runs") / run_name(declared.name, agent, seed)
    with _ending_in_time(out):
        run = api.train(
            declared,
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
            stop_at=stop_at,
            callbacks=watching(wandb),
            overwrite=overwrite,
        )
    _say_where(run)


def resume(
    run: Positional[Path],
    steps: OptionalCount = None,
    devices: OptionalCount = None,
    from_: Annotated[OptionalCount, arg(name="from")] = None,
    stop_at: float | None = None,
    wandb: str | None = None,
    on_env_error: Literal["stop", "restart"] | None = None,
) -> None:
    """Continue a run from its newest checkpoint.

    Args:
        run: Run folder.
        steps: New total of environment steps; default: the run's own.
        devices: New number of accelerators; default: the run's own.
        from_: Step of the checkpoint, 0 to start anew; later ones are renamed and kept.
        stop_at: New success that ends the run; 0: none.
        wandb: Project of Weights & Biases that is shown the run too.
        on_env_error: What a broken environment of others does from now on: stop the run or restart.
    """
    from midway import api
    from midway.runs.tracking import watching

    with _ending_in_time(run):
        continued = api.resume(
            run,
            steps=steps,
            devices=devices,
            progress=True,
            from_step=from_,
            stop_at=stop_at,
            on_env_error=on_env_error,
            callbacks=watching(wandb),
        )
    _say_where(continued)


def evaluate(
    run: Positional[Path],
    episodes: Count = 100,
    task: str | None = None,
    actions: Literal["mean", "sampled"] = "mean",
    seed: int = 0,
    policy: Kept = "last",
    set: Changes = (),
    json: bool = False,
) -> None:
    """Run episodes of a trained policy and print how many reach their goal.

    Args:
        run: Run folder.
        episodes: Number of episodes.
        task: hard, uniform, or a numbered case of the environment; default: hard, if there is one.
        actions: Mean or sampled actions.
        seed: Seed of starts and goals.
        policy: The best policy of the run, the last, or that of a step whose policy was kept.
        set: Settings of acting in place of the run's, as NAME=VALUE, such as num_subgoals=3 (leap).
        json: Print one JSON object, with every episode.
    """
    from midway import api

    result = api.evaluate(
        run,
        episodes=episodes,
        task=task,
        actions=actions,
        seed=seed,
        policy=policy,
        changes=settings(set),
    )
    if json:
        episodes_json = [dataclasses.asdict(episode) for episode in result.episodes]
        print_json(
            {
                "run": str(run),
                "task": result.task,
                "actions": actions,
                "seed": seed,
                "policy": policy,
                "changes": settings(set),
                "success_rate": result.success_rate,
                "interval": result.success[1:],
                "final_distance": result.final_distance,
                "episodes": episodes_json,
            }
        )
        return
    named = ", ".join(f"{name} {d:.3f} m" for name, d in result.final_distances.items())
    print(
        f"{run}: {result.task}, {actions} actions: success {result.success:.1%} of {episodes} "
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
    set: Changes = (),
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
    if sys.stderr.isatty():
        with Live(console=Console(stderr=True), refresh_per_second=1) as live:
            final = sweeps.run(wanted, out, lambda found: live.update(sweeps.table(found)), ray)
    else:
        final = sweeps.run(wanted, out, sweeps.Lines(print_line), ray)
    if any(status.state in ("stopped", "waiting") for status in final):
        print_line(f"stopped; type the same command again to go on: {out}")
        sys.exit(EXIT_SIGNAL + signal.SIGINT)
    failed = [status.job.name for status in final if status.state != "finished"]
    if failed:
        raise OSError(f"{len(failed)} runs failed ({', '.join(failed)}): see their .log in {out}")
    print(f"finished {out}")


def report(
    runs: Positional[tuple[Path, ...]],
    out: Path | None = None,
    policy: Kept = "last",
    set: Changes = (),
) -> None:
    """Draw figures and one HTML page from run folders.

    Args:
        runs: Run folders, or the folder of a sweep.
        out: Folder for the figures; default: figures in the run folder, or report beside the first.
        policy: The policies that are drawn: best, last, or those of a step.
        set: Settings of acting in place of the run's, as NAME=VALUE, such as num_subgoals=3 (leap).
    """
    from midway import reports

    for path in reports.report(run_folders(runs), out, policy, settings(set)):
        print(path)


def watch(
    run: Positional[Path],
    out: Path | None = None,
    task: str | None = None,
    episodes: Count = 1,
    seed: int = 0,
    policy: Kept = "last",
    set: Changes = (),
    live: bool = False,
) -> None:
    """Write a video of the policy with its imagined subgoals, or show it in a window.

    Args:
        run: Run folder.
        out: The file, .mp4 or .gif; default: videos/TASK.mp4 in the run folder.
        task: hard, uniform, or a numbered case of the environment; default: hard, if there is one.
        episodes: Number of episodes.
        seed: Seed of starts and goals.
        policy: The best policy of the run, the last, or that of a step whose policy was kept.
        set: Settings of acting in place of the run's, as NAME=VALUE, such as num_subgoals=3 (leap).
        live: Show the episodes in a window instead; needs a display.
    """
    from midway import reports

    if live:
        if out is not None:
            raise ConfigurationError(f"--out {out}: --live writes no file")
        reports.show(run, task, episodes, seed, policy, settings(set))
        return
    print(reports.watch(run, out, task, episodes, seed, policy, settings(set)))


COMMANDS: dict[str, Callable[..., None]] = {
    "check": check,
    "train": train,
    "resume": resume,
    "sweep": sweep,
    "tune": tune,
    "evaluate": evaluate,
    "report": report,
    "compare": compare,
    "watch": watch,
    "bench": bench,
    "envs": envs,
    "presets": presets,
    "doctor": doctor,
    "runs": runs,
    "export": export,
    "push": push,
    "pull": pull,
}


KEEPING = ("train", "resume", "sweep", "tune")
"""Commands that end by a signal with a checkpoint; the others keep nothing."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit with 0, 1 (failed while running), 2 (wrong use) or 128 + a signal."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"midway {importlib.metadata.version('midway')}")
        return
    try:
        command = parse(COMMANDS, arguments)
        from midway.training.compilation import use_compilation_cache

        use_compilation_cache()
        if list(arguments)[:1] and arguments[0] in KEEPING:
            with signals.ending_in_time():
                command()
            return
        from midway.training.progress import showing_stages

        with signals.ending_soon(), showing_stages():
            command()
    except ConfigurationError as error:
        _fail(EXIT_USAGE, error)
    except (NonFiniteError, BrokenEnvironmentError) as error:
        _fail(EXIT_FAILED, error)
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        _fail(EXIT_USAGE, error)
    except KeyboardInterrupt as error:
        _fail(EXIT_SIGNAL + getattr(error, "number", signal.SIGINT), "interrupted")
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


def _ending_in_time(path: Path) -> AbstractContextManager[None]:
    """End a run by a signal even where native code keeps Python from it."""
    from midway.runs import complete
    from midway.runs.folder import RunFolder

    folder = RunFolder(path)
    return signals.ending_in_time(
        lambda: f"interrupted in the middle of a step; {complete.left(folder)}",
        lambda: complete.is_saving(folder),
    )


def _say_where(run: "Run") -> None:
    state = "finished" if run.finished else "stopped; continue with: midway resume"
    with suppress(BrokenPipeError):  # whoever reads may have ended by the same signal
        print(f"{state} {run.path}", flush=True)
    if run.signal is not None:
        sys.exit(EXIT_SIGNAL + run.signal)
