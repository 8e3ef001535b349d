"""Whether everything of a run's last step is there."""

from midway import files, tables
from midway.errors import ConfigurationError
from midway.runs.folder import RunConfig, RunFolder, read_json
from midway.training.arrays import checked_arrays
from midway.training.checkpoint import steps_in


def missing(folder: RunFolder, steps: int) -> str:
    """Return what is missing of the last of these steps: nothing if the run is finished.

    A run that was ended early has its last step there.

    Raises:
        ConfigurationError: This is no run folder.
    """
    last = max(steps_in(folder.checkpoints), default=0)
    if (ended := folder.ended_at()) is not None:
        steps = min(steps, ended)
    if last < steps:
        return f"checkpoint of step {steps}"
    if policy_step(folder) != last:
        return f"policy of step {last}"
    return "" if is_evaluated(folder, last) else f"evaluation of step {last}"


def policy_step(folder: RunFolder) -> int | None:
    """Return the step of the saved policy; None unless both of its files are whole and agree."""
    try:
        step = read_json(folder.policy_config).get("step")
        _, said = checked_arrays(folder.policy_weights)
        if said.get("step", step) != step:
            return None
    except ConfigurationError:
        return None
    return step if isinstance(step, int) else None


def is_evaluated(folder: RunFolder, step: int) -> bool:
    """Return whether there is an evaluation of a step."""
    try:
        return bool((tables.read(folder.evaluation_file)["step"] == step).any())
    except (ConfigurationError, KeyError):
        return False


def had_checkpoint(folder: RunFolder, config: RunConfig) -> bool:
    """Return whether files tell that the run has written a checkpoint, which may be gone."""
    if folder.policy_weights.exists() or folder.policy_config.exists():
        return True
    # Rows after the step of the first checkpoint are only written once it is on disk.
    first = config.train.checkpoint_every + config.train.num_envs
    try:
        return bool((tables.read(folder.metrics_file)["step"] > first).any())
    except (ConfigurationError, KeyError):
        return False


def is_saving(folder: RunFolder) -> bool:
    """Return whether a checkpoint is being written, or an old one removed."""
    return any(folder.checkpoints.glob(f"*{files.UNFINISHED}"))


def left(folder: RunFolder) -> str:
    """Return what a run that was stopped can go on from."""
    newest = max(steps_in(folder.checkpoints), default=None)
    if newest is None:
        return f"there is no checkpoint yet, to begin anew: midway resume {folder.path}"
    return f"go on from the checkpoint of step {newest}: midway resume {folder.path}"
