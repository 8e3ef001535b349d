"""Goal-conditioned reinforcement learning with imagined subgoals."""

import importlib
from typing import Any

from midway.envs.registry import register_ids

register_ids()


_PUBLIC = {
    "train": "midway.api",
    "resume": "midway.api",
    "load": "midway.api",
    "evaluate": "midway.api",
    "goal_env": "midway.configuration",
    "maze_env": "midway.configuration",
    "push": "midway.runs.hub",
    "pull": "midway.runs.hub",
    "report": "midway.reports",
    "watch": "midway.reports",
    "make_vec": "midway.envs.registry",
}


def __getattr__(name: str) -> Any:
    """Import the public functions on first use, so that ``import midway`` stays quick."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'midway' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Name the public functions too."""
    return [*globals(), *_PUBLIC]
