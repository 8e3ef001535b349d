"""Tuning: trials of settings by Optuna, each on a core of this machine or of a Ray cluster.

The study is a SQLite file in its folder; typed again, it goes on, and runs that were interrupted
are resumed. The first trial is the preset itself, so that every study says what tuning was worth.
"""

import dataclasses
import json
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from midway import tables
from midway.cluster import on_ray
from midway.cluster.jobs import POLL_SECONDS, Execute, Job, Processes, execute
from midway.cluster.sweep import ending
from midway.errors import ConfigurationError, needing
from midway.runs.folder import RunFolder
from midway.spaces import Choice, Range, Scalar

if TYPE_CHECKING:
    import optuna
    from rich.table import Table

Pruner: TypeAlias = Literal["median", "hyperband", "none"]
SHOWN = 5
"""Finished trials in the table, the best ones."""


@dataclass(frozen=True)
class Plan:
    """What is tuned, and on what budget.

    Attributes:
        env: Environment name.
        agent: Agent name.
        preset: What the trials change: ``paper`` or ``quick``.
        steps: Environment steps of each run.
        seeds: Seeds of each trial, one run for each.
        space: What each setting may be.
        first: The preset's own values of these settings.
        options: Further options of ``midway train``.
        changes: Settings that are the same in all trials.
    """

    env: str
    agent: str
    preset: str
    steps: int
    seeds: tuple[int, ...]
    space: Mapping[str, Range | Choice]
    first: Mapping[str, Scalar]
    options: tuple[str, ...] = ()
    changes: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def job(self, number: int, seed: int, values: Mapping[str, object]) -> Job:
        """Return the run of a trial with a seed."""
        given = {**self.changes, **values, "steps": self.steps}
        words = ["--preset", self.preset, *self.options]
        words += ["--set", *[f"{name}={value}" for name, value in given.items()]]
        return Job(self.env, self.agent, seed, tuple(words), label=f"trial{number}")


# --- the study ------------------------------------------------------------------------------------


def run(
    plan: Plan,
    trials: int,
    folder: Path,
    show: Callable[["optuna.Study"], None],
    pruner: Pruner = "median",
    ray_address: str | None = None,
) -> "optuna.Study":
    """Run trials until the study has so many, one on each core, and return it.

    Args:
        plan: What is tuned.
        trials: Trials of the study in all.
        folder: Its folder; on a cluster, one that all machines share.
        show: Is told about the study every second.
        pruner: What stops trials early.
        ray_address: As of a sweep.

    Raises:
        ConfigurationError: Optuna is missing, the folder cannot be used or holds another study, or
            Ray is missing or not reached.
    """
    study = open_study(plan, folder, pruner)
    processes, turn = Processes(), threading.Lock()
    left = _interrupted(study)

    def work(run_job: Execute) -> None:
        while not processes.ending.is_set():
            with turn:
                trial = left.pop() if left else _next(study, plan, trials)
            if trial is None:
                return
            _try(study, trial, plan, folder, run_job)

    if ray_address is None:
        cores: Sequence[Execute] = [_on_core(n, processes) for n in sorted(os.sched_getaffinity(0))]
    else:
        cores = on_ray.processors(ray_address, processes.ending)
    workers = [threading.Thread(target=work, args=(core,), daemon=True) for core in cores]
    with ending(processes):
        for worker in workers:
            worker.start()
        while any(worker.is_alive() for worker in workers):
            show(study)
            time.sleep(POLL_SECONDS)
    show(study)
    return study


def _on_core(core: int, processes: Processes) -> Execute:
    """Return what runs a job on a core of this machine."""
    return lambda job, folder, stop: execute(job, folder, core, processes, stop)


def open_study(plan: Plan, folder: Path, pruner: Pruner = "median") -> "optuna.Study":
    """Return the study of a folder; a new one begins with the preset's own values.

    Raises:
        ConfigurationError: As `run`.
    """
    with needing("tune", "midway tune"):
        import optuna
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"cannot make folder {folder}: {error.strerror}") from error
    study = optuna.create_study(
        storage=f"sqlite:///{folder / 'study.db'}",
        study_name="midway",
        direction="maximize",
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(seed=plan.seeds[0]),
        pruner=_pruner(pruner, plan),
    )
    written = json.loads(json.dumps(dataclasses.asdict(plan)))
    if (there := study.user_attrs.get("plan", written)) != written:
        differ = ", ".join(name for name in written if there.get(name) != written[name])
        raise ConfigurationError(f"{folder} is a study with another {differ}: choose another --out")
    study.set_user_attr("plan", written)
    if not study.get_trials(deepcopy=False):
        study.enqueue_trial(dict(plan.first))
    return study


def _pruner(name: Pruner, plan: Plan) -> "optuna.pruners.BasePruner":
    """Return what stops trials early: no trial before a quarter of its first run."""
    from optuna import pruners

    least, most = plan.steps // 4, plan.steps * len(plan.seeds)
    if name == "median":
        return pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=least)
    if name == "hyperband":
        return pruners.HyperbandPruner(min_resource=max(1, least), max_resource=most)
    return pruners.NopPruner()


def _interrupted(study: "optuna.Study") -> list["optuna.Trial"]:
    """Return the trials that an earlier process began and did not end."""
    import optuna

    running = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,))
    return [optuna.Trial(study, trial._trial_id) for trial in running]


def _next(study: "optuna.Study", plan: Plan, trials: int) -> "optuna.Trial | None":
    """Return a new trial, unless there are enough."""
    import optuna

    waiting = optuna.trial.TrialState.WAITING
    begun = [t for t in study.get_trials(deepcopy=False) if t.state != waiting]
    if len(begun) >= trials:
        return None
    return study.ask({name: _distribution(choice) for name, choice in plan.space.items()})


def _distribution(choice: Range | Choice) -> "optuna.distributions.BaseDistribution":
    from optuna import distributions

    if isinstance(choice, Choice):
        return distributions.CategoricalDistribution(choice.values)
    if isinstance(choice.low, int) and isinstance(choice.high, int):
        return distributions.IntDistribution(choice.low, choice.high, log=choice.log)
    return distributions.FloatDistribution(choice.low, choice.high, log=choice.log)


# --- a trial --------------------------------------------------------------------------------------


def _try(
    study: "optuna.Study",
    trial: "optuna.Trial",
    plan: Plan,
    folder: Path,
    run_job: Execute,
) -> None:
    """Run a trial, one seed after the other, and tell the study what came of it."""
    import optuna

    known = set(study.trials[trial.number].intermediate_values)
    pruned = threading.Event()

    def stop() -> bool:
        for step, score in curve(plan, folder, trial.number):
            if step not in known:
                known.add(step)
                trial.report(score, step)
        if trial.should_prune():
            pruned.set()
        return pruned.is_set()

    for seed in plan.seeds:
        job = plan.job(trial.number, seed, trial.params)
        state = run_job(job, folder, stop)
        if pruned.is_set():
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            return
        if state == "stopped":  # the next process goes on from its checkpoint
            return
        if state == "failed":
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            return
    stop()
    study.tell(trial, curve(plan, folder, trial.number)[-1][1])


def curve(plan: Plan, folder: Path, number: int) -> list[tuple[int, float]]:
    """Return the score of a trial after each evaluation of its runs, seeds one after the other.

    The score is the mean success of all evaluations so far, each the mean of its tasks
    (deterministic policy): learning sooner counts, keeping it, and what is on the way to ``hard``.
    """
    steps: list[int] = []
    success: list[float] = []
    for index, seed in enumerate(plan.seeds):
        file = RunFolder(folder / plan.job(number, seed, {}).name).evaluation_file
        try:
            table = tables.read(file)
            shown = table["actions"] == "mean"
            rates = table["success_rate"][shown].astype(float)
            at, row = np.unique(table["step"][shown].astype(int), return_inverse=True)
        except (ConfigurationError, KeyError):  # no evaluation yet
            break
        steps += (index * plan.steps + at).tolist()
        success += (np.bincount(row, rates) / np.bincount(row)).tolist()
    means = np.cumsum(success) / np.arange(1, len(success) + 1)
    return list(zip(steps, means.tolist(), strict=True))


# --- what came of it ------------------------------------------------------------------------------


def winner(study: "optuna.Study", plan: Plan) -> str:
    """Return the best trial as a preset file, which ``--preset FILE`` takes.

    Raises:
        ConfigurationError: No trial is complete.
    """
    best = _complete(study)[0]
    values = {**plan.changes, **best.params}
    lines = [
        f"# Mean success over training: {best.value:.3f}.",
        f"# {plan.steps} steps, seeds {', '.join(map(str, plan.seeds))}.",
        f'base = "{plan.preset}"',
        "",
        "[[rule]]",
        f"env = {json.dumps(plan.env)}",
        f"agent = {json.dumps(plan.agent)}",
        f'source = "tuned: trial {best.number} of {len(study.trials)}"',
        "",
        "[rule.values]",
        *[f"{name} = {json.dumps(value)}" for name, value in values.items()],
    ]
    return "\n".join(lines) + "\n"


def scores(study: "optuna.Study") -> tuple[int, float, float | None]:
    """Return number and score of the best trial, and the score of the preset itself, if it ended.

    Raises:
        ConfigurationError: No trial is complete.
    """
    complete = _complete(study)
    preset = next((trial.value for trial in complete if trial.number == 0), None)
    return complete[0].number, float(complete[0].value or 0), preset


def results(study: "optuna.Study") -> tables.Table:
    """Return number, state, score and values of every trial, as columns."""
    trials = study.get_trials(deepcopy=False)
    columns: dict[str, list[object]] = {
        "trial": [trial.number for trial in trials],
        "state": [trial.state.name.lower() for trial in trials],
        "score": [_score(trial) for trial in trials],
    }
    for name in dict.fromkeys(name for trial in trials for name in trial.params):
        columns[name] = [trial.params.get(name, "") for trial in trials]
    return {name: np.array(column, dtype=object) for name, column in columns.items()}


def _complete(study: "optuna.Study") -> list["optuna.trial.FrozenTrial"]:
    import optuna

    done = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
    if not done:
        raise ConfigurationError("no trial is complete: see the .log files in the study's folder")
    return sorted(done, key=lambda trial: (-float(trial.value or 0), trial.number))


def table(study: "optuna.Study") -> "Table":
    """Return a table of the trials that run, and of the best ones, for a terminal."""
    from rich.table import Table

    trials = study.get_trials(deepcopy=False)
    running = [t for t in trials if t.state.name == "RUNNING"]
    complete = [t for t in trials if t.state.name == "COMPLETE"]
    best = sorted(complete, key=lambda t: -float(t.value or 0))[:SHOWN]
    ended = sum(t.state.is_finished() for t in trials)
    view = Table("trial", "state", "score", "values", title=f"{ended} trials ended")
    for trial in (*running, *best):
        values = ", ".join(
            f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in trial.params.items()
        )
        view.add_row(str(trial.number), trial.state.name.lower(), _score(trial), values)
    return view


def lines(study: "optuna.Study") -> list[str]:
    """Return number, state and score of every trial, a line for each."""
    trials = study.get_trials(deepcopy=False)
    return [f"trial {t.number}  {t.state.name.lower()}  {_score(t)}".rstrip() for t in trials]


def _score(trial: "optuna.trial.FrozenTrial") -> str:
    """Return the score of a trial so far; nothing before its first evaluation."""
    score, last = trial.value, trial.last_step
    if score is None and last is not None:
        score = trial.intermediate_values[last]
    return "" if score is None else f"{score:.3f}"
