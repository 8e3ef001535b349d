"""``midway compare``: whether one side of runs is better than another."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from midway.cli.parsing import run_folders


def compare(
    runs: Positional[tuple[Path, ...]],
    against: tuple[Path, ...] = (),
    task: str | None = None,
    actions: Literal["mean", "sampled"] = "mean",
    as_json: Annotated[bool, arg(name="json")] = False,
) -> None:
    """Say in one line whether runs are better than others, and how sure that is.

    Args:
        runs: Run folders, the folder of a sweep, or folders of their CSV files; without --against
            they must be of two agents or settings.
        against: The runs to compare with.
        task: hard or uniform; default: hard, if it was evaluated.
        actions: Mean or sampled actions.
        as_json: Print one JSON object.
    """
    from midway.reports import comparison

    found = comparison.compare(run_folders(runs), run_folders(against), task, actions)
    print(json.dumps({**asdict(found), "verdict": found.verdict}) if as_json else found)
