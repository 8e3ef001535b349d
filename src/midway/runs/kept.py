"""The policies of a run that were kept: the last, the best, and snapshots on the way."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from midway import tables
from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder
from midway.statistics import Estimate, of_policy
from midway.training.arrays import said_of

Which: TypeAlias = Literal["best", "last"] | int
"""A policy of a run: the best, the last, or that of a step whose weights were kept."""


@dataclass(frozen=True)
class Best:
    """How good the best policy of a run was on the episodes that confirmed it.

    Attributes:
        step: The environment step that it is of.
        task: What starts and goals were drawn from.
        success: Its success with deterministic actions.
    """

    step: int
    task: str
    success: Estimate


def best(folder: RunFolder) -> Best | None:
    """Return how good the best policy is; None if none was kept, or its file is damaged."""
    try:
        said = said_of(folder.best_weights)
        success = of_policy(said["success_rate"], said["episodes"])
        return Best(said["step"], said["task"], success)
    except (ConfigurationError, KeyError):
        return None


def weights_of(folder: RunFolder, which: Which = "last") -> Path:
    """Return the file of a policy's weights.

    Raises:
        ConfigurationError: It was not kept; the text names what there is.
    """
    if which == "last":
        return folder.policy_weights
    if which == "best":
        if folder.best_weights.exists():
            return folder.best_weights
        raise ConfigurationError(
            f"run folder {folder.path}: no best policy: {_why_no_best(folder)}: take the last one "
            "(--policy last)"
        )
    kept = {**snapshots(folder), **{step: file for file, step in _named(folder)}}
    if which not in kept:
        there = ", ".join(map(str, sorted(kept))) or "none"
        raise ConfigurationError(
            f"run folder {folder.path}: no policy of step {which} was kept: there are {there}"
        )
    return kept[which]


def _why_no_best(folder: RunFolder) -> str:
    """Return why a run has no best policy, by its evaluations of the task that chooses it."""
    try:
        table = tables.read(folder.evaluation_file)
        task = "hard" if (table["task"] == "hard").any() else "uniform"
        rates = table["success_rate"][(table["task"] == task) & (table["actions"] == "mean")]
    except (ConfigurationError, KeyError):
        return "no evaluation yet"
    if rates.any():
        return "no evaluation that reached goals was confirmed, or an earlier version trained it"
    return f"none of its {len(rates)} evaluations of {task} has reached a goal"


def _named(folder: RunFolder) -> Iterator[tuple[Path, int]]:
    """Yield the files that are called the best and the last, with the steps that they are of."""
    for file in (folder.best_weights, folder.policy_weights):
        with suppress(ConfigurationError):
            if "step" in (said := said_of(file)):
                yield file, said["step"]


def snapshots(folder: RunFolder) -> dict[int, Path]:
    """Return the weights that were kept on the way, by step."""
    names = {file.stem.removeprefix("step-"): file for file in folder.past_policies.glob("step-*")}
    return {int(n): f for n, f in names.items() if n.isdigit() and f.suffix == ".safetensors"}
