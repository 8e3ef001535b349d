"""Mazes of one's own, drawn with letters in a file; two of gymnasium-robotics lie beside it."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from types import MappingProxyType

import yaml

from midway.envs.mazes import MAZES, Case, Maze, Rectangle
from midway.errors import ConfigurationError

CELL = 4.0
"""Side of a cell where the file does not say (m); that of gymnasium-robotics' ant mazes."""
SMALLEST_CELL, LARGEST_CELL = 2.0, 100.0
"""An ant keeps 0.75 m from every wall, on both sides."""
LARGEST_MAP = 100
"""Rows and columns, at most."""
LARGEST_FILE = 20_000
"""Characters of a file, at most."""
NUMBERED = 8
"""Cases of growing distance, at most."""
TEST_HALF = 0.25
"""Half the side of the boxes that starts and goals of tests are drawn from (m)."""

Place = tuple[int, int]
"""Row and column of a cell, from 0."""


@dataclass(frozen=True)
class Layout:
    """A maze drawn with letters.

    Attributes:
        name: What it is called, such as ``umaze``.
        rows: The map, of ``#`` wall, ``.`` free, ``S`` start and ``G`` goal of the hard task.
        cell: Side of a cell (m).
    """

    name: str
    rows: tuple[str, ...]
    cell: float = CELL

    def __post_init__(self) -> None:
        """Check the map.

        Raises:
            ConfigurationError: It is no map of a maze; the text names the cell.
        """
        if self.name in MAZES:
            raise self._wrong("", "one of midway's own is called that: rename the file")
        if not SMALLEST_CELL <= self.cell <= LARGEST_CELL:
            limits = f"must be from {SMALLEST_CELL} to {LARGEST_CELL} m"
            raise self._wrong("", f"cell {self.cell}: {limits}")
        if not self.rows or max(len(self.rows), len(self.rows[0])) > LARGEST_MAP:
            raise self._wrong("", f"must have 1 to {LARGEST_MAP} rows and columns")
        self._check_letters()
        self._check_ways()

    def _check_letters(self) -> None:
        for number, row in enumerate(self.rows):
            if len(row) != len(self.rows[0]):
                many = f"{len(row)} cells, but the first row has {len(self.rows[0])}"
                raise self._wrong(f", row {number + 1}", many)
            for column, letter in enumerate(row):
                if letter not in "#.SG":
                    raise self._wrong(_named((number, column)), f"{letter!r} is none of # . S G")

    def _check_ways(self) -> None:
        for letter, role in (("S", "start"), ("G", "goal")):
            found = self._all(letter)
            if len(found) != 1:
                second = _named(found[1]) if found else ""
                needed = f"must have one {letter}, the {role} of the hard task, not {len(found)}"
                raise self._wrong(second, needed)
        reached = self._ways()
        for cell in [*self._all("G"), *self._all(".")]:
            if cell not in reached:
                raise self._wrong(
                    _named(cell), "cannot be reached from S: make it a wall, or open one"
                )

    def _wrong(self, where: str, what: str) -> ConfigurationError:
        return ConfigurationError(f"maze {self.name}{where}: {what}")

    @property
    def length(self) -> float:
        """Way from start to goal of the hard task, from cell to cell (m)."""
        return self.cell * (len(self._way()) - 1)

    def maze(self) -> Maze:
        """Return the maze, around the origin: tasks ``uniform``, ``hard``, and cases on the way."""
        height, width = len(self.rows), len(self.rows[0])
        arena = Rectangle(0.0, 0.0, width * self.cell / 2, height * self.cell / 2)
        start, *way = self._way()
        begin = self._box(start)
        cases = {"uniform": Case(arena, arena), "hard": Case(begin, self._box(way[-1]))}
        count = min(NUMBERED, len(way))
        for number in range(count):
            goal = way[(number + 1) * len(way) // count - 1]
            cases[f"case-{10 + number}"] = Case(begin, self._box(goal))
        return Maze(self.name, self.name, arena, self._walls(), MappingProxyType(cases))

    def to_json(self) -> dict[str, object]:
        """Return what a run folder stores."""
        return {"name": self.name, "rows": list(self.rows), "cell": self.cell}

    @staticmethod
    def from_json(stored: Mapping[str, object]) -> "Layout":
        """Return the layout that ``to_json`` was taken from.

        Raises:
            ConfigurationError: It is none.
        """
        name, rows, cell = (stored.get(key) for key in ("name", "rows", "cell"))
        whole = isinstance(rows, list) and all(isinstance(row, str) for row in rows)
        if not (whole and isinstance(name, str) and isinstance(cell, int | float)):
            raise ConfigurationError(f"maze {stored!r}: not understood")
        return Layout(name, tuple(map(str, rows if isinstance(rows, list) else ())), float(cell))

    def _all(self, letter: str) -> list[Place]:
        return [
            (row, column)
            for row, letters in enumerate(self.rows)
            for column, found in enumerate(letters)
            if found == letter
        ]

    def _free(self, row: int, column: int) -> bool:
        inside = 0 <= row < len(self.rows) and 0 <= column < len(self.rows[0])
        return inside and self.rows[row][column] != "#"

    def _ways(self) -> dict[Place, Place | None]:
        """Return every cell that is reached from the start, with the cell before it."""
        [start] = self._all("S")
        before: dict[Place, Place | None] = {start: None}
        waiting = deque([start])
        while waiting:
            row, column = waiting.popleft()
            for cell in (
                (row, column + 1),
                (row + 1, column),
                (row, column - 1),
                (row - 1, column),
            ):
                inside = 0 <= cell[0] < len(self.rows) and 0 <= cell[1] < len(self.rows[0])
                if inside and cell not in before and self.rows[cell[0]][cell[1]] != "#":
                    before[cell] = (row, column)
                    waiting.append(cell)
        return before

    def _way(self) -> list[Place]:
        """Return the cells from start to goal of the hard task."""
        before, [goal] = self._ways(), self._all("G")
        way, cell = [], before[goal]
        while cell is not None:
            way.append(cell)
            cell = before[cell]
        return [*way[::-1], goal]

    def _middle(self, row: float, column: float) -> tuple[float, float]:
        """Return x and y of a place counted in cells (m)."""
        return (
            (column - len(self.rows[0]) / 2) * self.cell,
            (len(self.rows) / 2 - row) * self.cell,
        )

    def _box(self, cell: Place) -> Rectangle:
        return Rectangle(*self._middle(cell[0] + 0.5, cell[1] + 0.5), TEST_HALF, TEST_HALF)

    def _walls(self) -> tuple[Rectangle, ...]:
        """Return the walls as few rectangles: runs in a row, joined where the next row has them."""
        open_runs: dict[tuple[int, int], int] = {}
        walls = []
        for row in range(len(self.rows) + 1):
            runs = _runs(self.rows[row]) if row < len(self.rows) else []
            for run in [run for run in open_runs if run not in runs]:
                walls.append(self._wall(run, open_runs.pop(run), row))
            open_runs |= {run: row for run in runs if run not in open_runs}
        return tuple(walls)

    def _wall(self, columns: tuple[int, int], first: int, end: int) -> Rectangle:
        middle = self._middle((first + end) / 2, sum(columns) / 2)
        half = self.cell / 2
        return Rectangle(*middle, (columns[1] - columns[0]) * half, (end - first) * half)


def read(source: str | Path) -> Layout:
    """Return the layout in a file, or one of midway's by its name.

    Args:
        source: A file of letters, or of YAML with ``map`` and ``cell``; ``umaze`` or ``medium``.

    Raises:
        ConfigurationError: The file cannot be read, or holds no map of a maze.
    """
    shipped = resources.files(__name__) / f"{source}.yaml"
    path = Path(source)
    try:
        with shipped.open() if shipped.is_file() else path.open() as file:
            text = file.read(LARGEST_FILE + 1)
    except (OSError, UnicodeDecodeError) as error:
        known = ", ".join(sorted(names()))
        raise ConfigurationError(
            f"maze {source}: cannot be read ({error}); it is a file, or one of {known}"
        ) from error
    if len(text) > LARGEST_FILE:
        raise ConfigurationError(f"maze {source}: has more than {LARGEST_FILE} characters")
    cell: object = CELL
    if shipped.is_file() or path.suffix in (".yaml", ".yml"):
        text, cell = _of_yaml(str(source), text)
    rows = tuple(line.rstrip() for line in text.strip("\n").splitlines())
    return Layout(path.stem, _without_rim(rows), float(str(cell)))


def names() -> list[str]:
    """Return the names of the layouts that midway has."""
    files = [Path(file.name) for file in resources.files(__name__).iterdir()]
    return [file.stem for file in files if file.suffix == ".yaml"]


def _of_yaml(source: str, text: str) -> tuple[str, float]:
    """Return map and cell of a YAML file.

    Raises:
        ConfigurationError: It has others, or none.
    """
    try:
        found = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # dates, numbers, depth
        raise ConfigurationError(f"maze {source}: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict) or not {"map"} <= set(found) <= {"map", "cell"}:
        raise ConfigurationError(f"maze {source}: must have map, and may have cell")
    drawn, cell = found["map"], found.get("cell", CELL)
    if not isinstance(drawn, str) or isinstance(cell, bool) or not isinstance(cell, int | float):
        raise ConfigurationError(f"maze {source}: map must be text, and cell a number of metres")
    return drawn, float(cell)


def _without_rim(rows: tuple[str, ...]) -> tuple[str, ...]:
    """Return the map without walls all around it, which every maze has anyhow."""
    if len(rows) < 3 or len({len(row) for row in rows}) != 1:
        return rows
    rim = {*rows[0], *rows[-1], *(row[0] for row in rows if row), *(row[-1] for row in rows if row)}
    return tuple(row[1:-1] for row in rows[1:-1]) if rim == {"#"} else rows


def _runs(row: str) -> list[tuple[int, int]]:
    """Return where walls begin and end in a row."""
    padded = f".{row}."
    edges = [i for i in range(len(row) + 1) if (padded[i] == "#") != (padded[i + 1] == "#")]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _named(cell: Place) -> str:
    return f", row {cell[0] + 1}, column {cell[1] + 1}"
