"""The command `midway tune`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from midway import tables
from midway.cli.about import NOTHING, AboutEnv
from midway.cli.parsing import Changes, Count, OptionalCount, settings
from midway.errors import ConfigurationError
from midway.training.terminal import print_line

if TYPE_CHECKING:
    from optuna import Study

    from midway.cluster.tune import Plan

EXIT_INTERRUPTED = 130


def tune(
    env: Positional[str],
    agent: str = "ris",
    trials: Count = 20,
    preset: Literal["paper", "quick"] = "quick",
    steps: OptionalCount = None,
    seeds: tuple[int, ...] = (0,),
    pruner: Literal["median", "hyperband", "none"] = "median",
    space: Path | None = None,
    out: Path | None = None,
    ray: str | None = None,
    set: Changes = (),
    about: AboutEnv = NOTHING,
) -> None:
    """Look for better settings than a preset's, and write them as a preset file.

    Args:
        env: Environment name, a Gymnasium id, module:Id or module:callable.
        agent: Agent name.
        trials: Trials of the study in all; typed again with more, it goes on.
        preset: What is tuned; its own values are the first trial.
        steps: Environment steps of each run; default: the preset's.
        seeds: Seeds of each trial: one run for each.
        pruner: What stops trials that are behind: median, hyperband or none.
        space: TOML file of what may be tried; default: learning rates and a few others.
        out: Folder of the study; default: runs/tune-ENV-AGENT.
        ray: Address of a Ray cluster (auto: the one of this machine) whose machines share the
            folder; default: this machine's cores, one trial on each.
        set: Settings that are the same in all trials, as NAME=VALUE.
        about: What midway must be told of an environment that is not its own.
    """
    from rich.console import Console
    from rich.live import Live

    from midway.cluster import tune as tuning
    from midway.runs.folder import run_name

    if trials < 1 or not seeds:
        raise ConfigurationError("nothing to do: give at least one trial and one seed")
    plan = _plan(env, agent, preset, steps, seeds, space, settings(set), about)
    out = out or Path("runs") / run_name(f"tune-{env}", agent, seeds[0]).rpartition("-seed")[0]
    tuning.open_study(plan, out, pruner)
    if sys.stderr.isatty():
        with Live(console=Console(stderr=True), refresh_per_second=1) as live:
            study = tuning.run(
                plan, trials, out, lambda s: live.update(tuning.table(s)), pruner, ray
            )
    else:
        told: dict[str, None] = {}

        def tell(study: "Study") -> None:
            for line in tuning.lines(study):
                if line not in told:
                    told[line] = None
                    print_line(line)

        study = tuning.run(plan, trials, out, tell, pruner, ray)
    if sum(trial.state.is_finished() for trial in study.trials) < trials:
        print_line(f"stopped; type the same command again to go on: {out}")
        sys.exit(EXIT_INTERRUPTED)
    number, score, own = tuning.scores(study)
    (out / "best.toml").write_text(tuning.winner(study, plan))
    tables.write(out / "trials.csv", tuning.results(study))
    compared = "did not end" if own is None else f"{own:.3f}"
    print(f"trial {number}: mean success {score:.3f} over training; {preset} itself: {compared}")
    print(f"{out / 'best.toml'}")


def _plan(
    env: str,
    agent: str,
    preset: str,
    steps: int | None,
    seeds: tuple[int, ...],
    space: Path | None,
    changes: dict[str, str],
    about: AboutEnv,
) -> "Plan":
    """Return what is tuned.

    Raises:
        ConfigurationError: A name or value cannot be used.
    """
    from midway import api, spaces
    from midway import settings as declarations
    from midway.cluster.tune import Plan

    given = changes if steps is None else changes | {"steps": str(steps)}
    config = api.configure(about.env(env), agent, preset, seeds[0], given)
    parts = (config.train, config.hyperparameters)
    wanted = spaces.of(parts, None if space is None else spaces.read(space))
    if twice := sorted(wanted.keys() & changes.keys()):
        raise ConfigurationError(f"--set {', '.join(twice)}: in the search space as well")
    first = {
        name: value
        for part in parts
        for name, value, _ in declarations.declared(part)
        if name in wanted and isinstance(value, bool | int | float | str)
    }
    kept = {name: value for name, value in changes.items() if name != "steps"}
    options = tuple(about.options())
    return Plan(env, agent, preset, config.train.steps, seeds, wanted, first, options, kept)
