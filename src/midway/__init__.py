"""Goal-conditioned reinforcement learning with imagined subgoals."""

from typing import Any

from midway.envs.ids import register_ids

register_ids()


def __getattr__(name: str) -> Any:
    """Import the public functions on first use, so that ``import midway`` stays quick."""
    if name == "make_vec":
        from midway.envs.registry import make_vec

        return make_vec
    raise AttributeError(f"module 'midway' has no attribute {name!r}")
