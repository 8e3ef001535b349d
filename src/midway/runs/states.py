"""How far the runs below a folder are."""

from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from midway.errors import ConfigurationError
from midway.runs import complete
from midway.runs.folder import RunFolder
from midway.training.checkpoint import steps_in

State: TypeAlias = Literal["running", "interrupted", "finished", "broken"]

DEPTH = 3
"""Folders within each other that are looked into: of a sweep, and of several."""


class RunState(NamedTuple):
    """How far a run is.

    Attributes:
        state: ``running``: a process trains it. ``interrupted``: it can go on. ``finished``.
            ``broken``: its description cannot be read, or its checkpoints are gone.
        step: Environment step of its newest checkpoint.
        steps: Steps that it shall take; None where that cannot be read.
        why: What is broken or missing, in one line.
    """

    state: State
    step: int
    steps: int | None
    why: str = ""


def found_below(folder: Path) -> list[Path]:
    """Return the run folders in a folder and in those within it, or itself, sorted by name.

    Raises:
        ConfigurationError: There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigurationError(f"there is no folder {folder}")
    levels = ["*/" * depth for depth in range(DEPTH)]
    return sorted(file.parent for level in levels for file in folder.glob(f"{level}config.json"))


def state_of(path: Path) -> RunState:
    """Return how far a run is; nothing is changed, and checksums of checkpoints are not read."""
    folder = RunFolder(path)
    step = max(steps_in(folder.checkpoints), default=0)
    try:
        config = folder.load_config()
        steps, missing = config.train.steps, complete.missing(folder, config.train.steps)
        lost = not step and complete.had_checkpoint(folder, config)
    except ConfigurationError as error:
        return RunState("broken", step, None, " ".join(str(error).split()))
    if folder.in_use():
        return RunState("running", step, steps)
    if lost:
        kept = complete.policy_step(folder)
        left = "" if kept is None else f"; its policy of step {kept:,} is there"
        return RunState("broken", step, steps, f"its checkpoints are gone{left}")
    return (
        RunState("interrupted", step, steps, f"no {missing}")
        if missing
        else RunState("finished", step, steps)
    )
