"""Rows for CSV files and TensorBoard."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path

from tensorboardX import SummaryWriter

from midway.training.evaluate import Evaluation

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


class Table:
    """A CSV file that rows are appended to; the first row decides the columns.

    Args:
        path: The file.
        until: Keep only rows up to this step: what follows will be computed again.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path = path
        self._columns: list[str] | None = None
        if path.exists():
            self._truncate(until)

    def write(self, row: Mapping[str, object]) -> None:
        """Append one row and put it on disk.

        Values of columns that the first row did not have are not written.
        """
        if self._columns is None:
            self._columns = list(row)
            with self._path.open("w", newline="") as file:
                csv.writer(file).writerow(self._columns)
        with self._path.open("a", newline="") as file:
            csv.writer(file).writerow([row.get(column, "") for column in self._columns])

    def _truncate(self, until: int) -> None:
        with self._path.open(newline="") as file:
            rows = list(csv.reader(file))
        if not rows:
            return
        self._columns = rows[0]
        step = self._columns.index("step")
        # A last line that a killed process wrote in part has too few values.
        kept = [r for r in rows[1:] if len(r) == len(rows[0]) and int(r[step]) <= until]
        temporary = self._path.with_name(self._path.name + ".new")
        with temporary.open("w", newline="") as file:
            csv.writer(file).writerows([rows[0], *kept])
        temporary.replace(self._path)


class Logger:
    """The files that a run writes its numbers to.

    Args:
        metrics: ``metrics.csv``.
        evaluation: ``evaluation.csv``.
        events: Folder of TensorBoard event files.
        until: Step that the run continues from; later rows of the files are dropped.
    """

    def __init__(self, metrics: Path, evaluation: Path, events: Path, until: int) -> None:
        self._metrics = Table(metrics, until)
        self._evaluation = Table(evaluation, until)
        self._events = SummaryWriter(str(events), purge_step=until + 1 if until else None)

    def metrics(self, step: int, values: Mapping[str, int | float]) -> None:
        """Write one row of scalars; a value that is not a number is left out."""
        known = {name: value for name, value in values.items() if not math.isnan(value)}
        self._metrics.write({"step": step, **dict.fromkeys(values, ""), **known})
        for name, value in known.items():
            self._events.add_scalar(name, value, step)

    def evaluation(self, step: int, clock: Mapping[str, int | float], result: Evaluation) -> None:
        """Write one row for an evaluated task and kind of action."""
        values = {
            "success_rate": result.success_rate,
            "final_distance": result.final_distance,
            "episode_length": result.length,
            **{f"final_distance_{name}": d for name, d in result.final_distances.items()},
        }
        row = {"task": result.task, "actions": result.actions, "episodes": len(result.episodes)}
        row = {"step": step, **clock, **row, **values}
        columns = dict.fromkeys([*EVALUATION_COLUMNS, *values])
        self._evaluation.write({column: row[column] for column in columns})
        for name, value in values.items():
            self._events.add_scalar(f"eval/{result.task}/{result.actions}/{name}", value, step)

    def close(self) -> None:
        """Put everything on disk."""
        self._events.close()
