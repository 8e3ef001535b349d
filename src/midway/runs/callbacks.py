"""What a run shows to those who watch it, and how they end it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from midway import tables
from midway.errors import ConfigurationError
from midway.runs import policy as policies
from midway.runs.folder import RunConfig, RunFolder
from midway.runs.policy import Policy
from midway.training.evaluate import Evaluation
from midway.training.state import Training

IN_A_ROW = 3
"""Evaluations that must reach ``stop_at`` one after the other: one alone may be lucky."""


@dataclass(frozen=True)
class Event:
    """A row of metrics, or the evaluations of a step.

    Attributes:
        config: The configuration of the run.
        path: The run folder.
        step: Environment steps so far.
        metrics: The row as in ``metrics.csv``; nothing where this is an evaluation.
        evaluations: One for each task and kind of action; nothing where this is a row.
    """

    config: RunConfig
    path: Path
    step: int
    metrics: Mapping[str, int | float]
    evaluations: tuple[Evaluation, ...]
    _training: Training = field(repr=False)

    @property
    def policy(self) -> Policy:
        """The policy of this step, a copy that may be kept; ask for it inside the callback."""
        return policies.current(self.config, self._training)


Callback: TypeAlias = Callable[[Event], bool | None]
"""Is called after each row of metrics and each evaluation; True ends the run at this step."""


class Watchers:
    """Shows a run to its callbacks, and ends it by them or by its setting ``stop_at``.

    Args:
        config: The configuration of the run.
        folder: Its folder.
        callbacks: Are called in this order.
    """

    def __init__(self, config: RunConfig, folder: RunFolder, callbacks: Sequence[Callback]) -> None:
        self._config = config
        self._folder = folder
        self._callbacks = callbacks
        self._task = config.declaration().shown_task

    def verdict(
        self,
        training: Training,
        metrics: Mapping[str, int | float],
        evaluations: Sequence[Evaluation],
    ) -> str:
        """Show something to every callback; return why the run ends, or nothing if it goes on."""
        config, path, step = self._config, self._folder.path, training.counters.steps
        event = Event(config, path, step, metrics, tuple(evaluations), training)
        asked = [callback for callback in self._callbacks if callback(event) is True]
        if evaluations and self._good_enough():
            return f"success reached stop_at {config.train.stop_at:g} {IN_A_ROW} times in a row"
        return "a callback asked for it" if asked else ""

    def _good_enough(self) -> bool:
        """Return whether the last evaluations of the task that is shown all reached ``stop_at``.

        They are read from their file, so that a run which was resumed ends where it would have.
        """
        if not (wanted := self._config.train.stop_at):
            return False
        try:
            table = tables.read(self._folder.evaluation_file)
            chosen = (table["task"] == self._task) & (table["actions"] == "mean")
            last = table["success_rate"][chosen][-IN_A_ROW:]
        except (ConfigurationError, KeyError):
            return False
        return len(last) == IN_A_ROW and bool(np.all(last >= wanted))
