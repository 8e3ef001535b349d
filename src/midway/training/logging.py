"""The numbers of a run, into CSV files and TensorBoard."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from midway.tables import Appender
from midway.training.evaluate import Evaluation
from midway.training.events import Events

EVALUATION_COLUMNS = (
    "step",
    "updates",
    "seconds",
    "training_seconds",
    "task",
    "actions",
    "episodes",
    "success_rate",
    "final_distance",
    "episode_length",
)


class Logger:
    """The files that a run writes its numbers to.

    Args:
        metrics: ``metrics.csv``.
        evaluation: ``evaluation.csv``.
        events: Folder of TensorBoard event files.
        until: Step that the run continues from; later rows of the files are dropped, and those of
            step 0 where it begins.
        say: Is told when events cannot be written.

    Raises:
        OSError: The CSV files cannot be written.
        ConfigurationError: They hold something else.
    """

    def __init__(
        self,
        metrics: Path,
        evaluation: Path,
        events: Path,
        until: int,
        say: Callable[[str], None],
    ) -> None:
        self._metrics, self._evaluation = (
            Appender(path, until or -1) for path in (metrics, evaluation)
        )
        self._events = Events(events, until, say)

    def metrics(self, step: int, values: Mapping[str, int | float]) -> None:
        """Write one row of scalars; a value that is not a number is left out."""
        known = {name: value for name, value in values.items() if not math.isnan(value)}
        self._metrics.write({"step": step, **dict.fromkeys(values, ""), **known})
        self._events.scalars(step, known)

    def evaluation(
        self, step: int, clock: Mapping[str, int | float], results: Sequence[Evaluation]
    ) -> None:
        """Write a row for each evaluated task and kind of action: all of them, or none."""
        rows = [_row({"step": step, **clock}, result) for result in results]
        self._evaluation.write_together(rows)
        for result in results:
            prefix = f"eval/{result.task}/{result.actions}"
            values = _values(result).items()
            self._events.scalars(step, {f"{prefix}/{name}": value for name, value in values})

    def close(self) -> None:
        """Put everything on disk."""
        self._events.close()


def _values(result: Evaluation) -> dict[str, float]:
    return {
        "success_rate": result.success_rate,
        "final_distance": result.final_distance,
        "episode_length": result.length,
        **{f"final_distance_{name}": d for name, d in result.final_distances.items()},
    }


def _row(when: Mapping[str, int | float], result: Evaluation) -> dict[str, object]:
    values = _values(result)
    what = {"task": result.task, "actions": result.actions, "episodes": len(result.episodes)}
    row = {**when, **what, **values}
    return {column: row[column] for column in dict.fromkeys([*EVALUATION_COLUMNS, *values])}
