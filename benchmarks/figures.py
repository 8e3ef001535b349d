"""Draw one figure of the documentation: its PNG file is written where the documentation shows it.

    python benchmarks/figures.py point-mazes
    python benchmarks/figures.py point-u-subgoals --runs DIR

Curves come from the CSV files in ``benchmarks/results``, success by difficulty from the policies
in ``zoo``. What was imagined during training needs the run folders themselves: ``--runs`` is the
folder that ``benchmarks/run.py`` was given.
"""

import argparse
import shutil
import sys
import tempfile
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from midway.reports import comparison, compose, curves, difficulty, style
from midway.reports.cache import Cache
from midway.reports.runs import by_environment, read
from midway.reports.style import Picture
from midway.runs.folder import ZOO

HERE = Path(__file__).parent
RESULTS = HERE / "results"


@dataclass(frozen=True)
class Source:
    """Where a figure comes from.

    Attributes:
        runs: Patterns of run folders.
        file: Its name in the report of these runs.
        out: Where it goes, in the repository.
        where: The folder that holds the run folders; None for that of ``--runs``.
    """

    runs: tuple[str, ...]
    file: str
    out: str
    where: Path | None = RESULTS


FIGURES = {
    "point-mazes": Source(
        ("point-mazes/*",), "all-learning-curves", "benchmarks/figures/point-mazes.png"
    ),
    "point-u": Source(
        ("point-mazes/point-u-*",), "point-u-learning-curves", "benchmarks/figures/point-u.png"
    ),
    "point-u-agents": Source(
        ("point-mazes/point-u-*-seed[012]", "point-u-agents/*"),
        "point-u-learning-curves",
        "benchmarks/figures/point-u-agents.png",
    ),
    **{
        f"{env}-difficulty": Source(
            (f"{env}-*",),
            f"{env}-difficulty",
            f"benchmarks/figures/{env}-difficulty.png",
            ZOO,
        )
        for env in ("point-u", "point-s", "point-omega", "ant-s", "ant-omega")
    },
    "point-u-subgoals": Source(
        ("point-u-ris-seed0",), "point-u-ris-subgoals", "docs/images/point-u-subgoals.png", None
    ),
    "ant-u": Source(("ant-u/*",), "ant-u-learning-curves", "benchmarks/figures/ant-u.png"),
    "ant-u-fast": Source(
        ("ant-u-fast/*", "ant-u/ant-u-ris-*"),
        "ant-u-learning-curves",
        "benchmarks/figures/ant-u-fast.png",
    ),
    **{
        f"ant-pi-{what}": Source(
            ("ant-pi-ris-discount-0.99",),
            f"ant-pi-ris-{what}",
            f"benchmarks/figures/ant-pi-{what}.png",
            None,
        )
        for what in ("values", "subgoals")
    },
    "paper": Source(
        ("ant-mazes/*", "arm/*"), "all-learning-curves", "benchmarks/figures/paper.png"
    ),
    "ant-omega-subgoals": Source(
        ("ant-omega-ris-seed1",),
        "ant-omega-ris-subgoals",
        "benchmarks/figures/ant-omega-subgoals.png",
        None,
    ),
    **{
        f"{env}{suffix}": Source(
            tuple(f"arm/{env}-{agent}-seed*" for agent in ("ris", "sac", "leap")),
            f"{env}-{file}",
            f"benchmarks/figures/{env}{suffix}.png",
        )
        for env in ("push", "push-state")
        for suffix, file in (("", "learning-curves"), ("-distances", "distances"))
    },
    "push-images": Source(
        ("push-ris-seed0",), "push-ris-images", "benchmarks/figures/push-images.png", None
    ),
}
"""Every figure by its name."""


def main() -> None:
    """Draw one figure and print where it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--runs", type=Path, help="folder of the run folders")
    arguments = parser.parse_args()
    source = FIGURES[arguments.figure]
    folder = source.where or arguments.runs
    if folder is None:
        sys.exit(f"{arguments.figure} needs policies: give --runs, the folder of the run folders")
    runs = sorted(path for pattern in source.runs for path in folder.glob(pattern) if path.is_dir())
    if not runs:
        sys.exit(f"no runs like {', '.join(source.runs)} in {folder}: see benchmarks/README.md")
    with tempfile.TemporaryDirectory() as temporary:
        picture = find(source.file, runs, Path(temporary))
        if picture is None:
            sys.exit(f"these runs have no {source.file}: see what their report says is missing")
        files = style.save(picture.draw(), Path(temporary) / picture.stem)
        print(shutil.copy(files[0], HERE.parent / source.out))


def find(stem: str, runs: list[Path], tables: Path) -> Picture | None:
    """Return the figure of this name in the report of these runs; nothing else is drawn."""
    environments = by_environment([read(path) for path in runs])
    for runs in environments:
        if stem == f"{runs.slug}-difficulty":  # a report leaves sampled actions out: half the time
            return next(difficulty.figures(runs, Cache(tables), tuple(difficulty.KINDS)), None)
    of_each = (compose.pictures(runs, Cache(tables)) for runs in environments)
    pictures = chain(curves.overview(environments), comparison.overview(environments), *of_each)
    return next((picture for picture in pictures if picture.stem == stem), None)


if __name__ == "__main__":
    main()
