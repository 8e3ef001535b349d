"""Whole states on disk: written completely or not at all."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from midway.types import ConfigurationError

KEPT = 2
"""Checkpoints kept: the newest, and the one before it should the newest be damaged."""


class Checkpoints:
    """Checkpoints of one run, by environment step.

    Saving waits until everything is on disk: the arrays are donated to the next update, and a
    second copy of a replay of images would not fit beside the first.
    """

    def __init__(self, folder: Path) -> None:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, enable_async_checkpointing=False, create=True
        )
        self._manager = ocp.CheckpointManager(
            folder.absolute(), options=options, item_handlers=ocp.StandardCheckpointHandler()
        )

    def save(self, step: int, state: Any) -> None:
        """Write a state, a nested dictionary of arrays, unless that of this step is there.

        Raises:
            OSError: It cannot be written; the checkpoints before it are as they were.
        """
        if step == self.latest():
            return
        try:
            self._manager.save(step, args=ocp.args.StandardSave(state), force=True)
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise OSError(f"checkpoint of step {step} cannot be written: {reason}") from error

    def latest(self) -> int | None:
        """Return the step of the newest whole checkpoint."""
        step: int | None = self._manager.latest_step()
        return step

    def parts(self, step: int) -> tuple[str, ...]:
        """Return the names of what a checkpoint holds; nothing if it cannot be read."""
        return tuple(self._manager.item_metadata(step) or {})

    def restore(self, step: int, like: Any) -> Any:
        """Return the state of a step, with the structure, shapes and dtypes of ``like``.

        Raises:
            ConfigurationError: The checkpoint is damaged or belongs to another run.
        """
        try:
            target = jax.tree.map(_abstract, self._stored(step, like))
            return self._manager.restore(step, args=ocp.args.StandardRestore(target))
        except (ValueError, KeyError, FileNotFoundError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigurationError(
                f"checkpoint of step {step} cannot be read: {reason}"
            ) from error

    def _stored(self, step: int, like: Any) -> Any:
        """Return ``like`` without the sums that checkpoints of earlier versions do not have."""
        stored = self._manager.item_metadata(step) or {}
        if "logged" in stored.get("collector", {}):
            return like
        kept = {name: part for name, part in like["collector"].items() if name != "logged"}
        return {**like, "collector": kept}

    def close(self) -> None:
        """Free what the manager holds."""
        self._manager.close()


def _abstract(leaf: Any) -> Any:
    """Describe an array: NumPy arrays come back as NumPy arrays, others on their devices."""
    if isinstance(leaf, jax.Array):
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)
    return np.empty(leaf.shape, leaf.dtype)
