"""CSV files: whole tables, and rows that are appended as a run goes on."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from midway import files
from midway.errors import ConfigurationError
from midway.types import NumPyArray

Table: TypeAlias = dict[str, NumPyArray]
"""Columns by name: float64, or text for the columns of ``TEXT_COLUMNS``."""

TEXT_COLUMNS = ("task", "actions")


def read(path: Path) -> Table:
    """Return the columns of a CSV file; none if it is not there or has no rows.

    A last line that is being written while we read is left out.

    Raises:
        ConfigurationError: The file holds something else.
    """
    if not path.exists():
        return {}
    try:
        header, *rows = _rows(path) or [[]]
        whole = _whole(header, rows)
        columns = dict(zip(header, zip(*whole, strict=True), strict=False))
        return {
            name: np.array(values)
            if name in TEXT_COLUMNS
            else np.array([value or "nan" for value in values], np.float64)
            for name, values in columns.items()
        }
    except (OSError, ValueError, csv.Error) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error


def _whole(header: list[str], rows: list[list[str]]) -> list[list[str]]:
    """Return the rows without a last one that is being written.

    Raises:
        ValueError: Another row has not as many values as there are columns.
    """
    for number, row in enumerate(rows, 2):
        last = number == len(rows) + 1
        if len(row) != len(header) and (len(row) > len(header) or not last):
            raise ValueError(f"line {number} has {len(row)} values for {len(header)} columns")
    return rows if not rows or len(rows[-1]) == len(header) else rows[:-1]


def write(path: Path, table: Mapping[str, NumPyArray]) -> None:
    """Write a CSV file that is there whole or not at all; numbers with six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = [
        [f"{value:.6g}" if isinstance(value, float) else value for value in column.tolist()]
        for column in table.values()
    ]
    _replace(path, [list(table), *zip(*columns, strict=True)])


class Appender:
    """A CSV file that rows are appended to; the first row decides the columns.

    Args:
        path: The file.
        until: Keep only rows up to this step: what follows will be computed again.

    Raises:
        ConfigurationError: The file holds something else.
        OSError: It cannot be read or written.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path = path
        self._columns: list[str] | None = None
        if path.exists():
            self._truncate(until)

    def write(self, row: Mapping[str, object]) -> None:
        """Append one row and put it on disk.

        Values of columns that the first row did not have are not written.

        Raises:
            OSError: It cannot be written; a part of it may be there.
        """
        if self._columns is None:
            _replace(self._path, [self._columns_of(row)])
        values = [row.get(column, "") for column in self._columns_of(row)]
        try:
            with self._path.open("a", newline="") as file:
                csv.writer(file).writerow(values)
        except OSError as error:
            raise files.named(error, self._path) from error

    def write_together(self, rows: Sequence[Mapping[str, object]]) -> None:
        """Append rows that are there all or none; the whole file is written for them.

        Raises:
            OSError: They cannot be written; none of them is there.
        """
        columns = self._columns_of(rows[0])
        before = _rows(self._path) if self._path.exists() else [columns]
        values = [[row.get(column, "") for column in columns] for row in rows]
        _replace(self._path, [*before, *values])

    def _columns_of(self, row: Mapping[str, object]) -> list[str]:
        """Return the columns, which the first row decides."""
        self._columns = self._columns or list(row)
        return self._columns

    def _truncate(self, until: int) -> None:
        try:
            rows = _rows(self._path) or [[]]
            # A last line that a killed process wrote in part has too few values.
            whole = [row for row in rows[1:] if len(row) == len(rows[0])]
            kept = [row for row in whole if int(row[rows[0].index("step")]) <= until]
        except (ValueError, csv.Error) as error:
            raise ConfigurationError(
                f"{self._path} is damaged, rename it to go on: {error}"
            ) from error
        if kept:
            self._columns = rows[0]
            _replace(self._path, [rows[0], *kept])
        else:  # the first row decides the columns anew
            self._path.unlink()


def _rows(path: Path) -> list[list[str]]:
    """Return the rows of a file; a last line without its end was cut, maybe inside a number."""
    with path.open(newline="") as file:
        text = file.read()
    rows = list(csv.reader(io.StringIO(text, newline="")))
    return rows if len(rows) < 2 or text.endswith("\n") else rows[:-1]


def _replace(path: Path, rows: Sequence[Sequence[object]]) -> None:
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    files.write(path, text.getvalue().encode())
