"""What environments show that no agent may learn from."""

import numpy as np

from midway.errors import NonFiniteObservationError
from midway.types import Info, NumPyArray, Observations, VectorGoalEnv


def finite(observation: Observations) -> NumPyArray:
    """Return which environments show finite numbers alone ``(K,)``."""
    batches = [batch for batch in observation.values() if batch.dtype.kind == "f"]
    sound = np.ones(len(observation["observation"]), np.bool_)
    for batch in batches:
        sound &= np.isfinite(batch).reshape(len(batch), -1).all(1)
    return sound


def not_finite(
    env: VectorGoalEnv, sound: NumPyArray, info: Info, actions: NumPyArray
) -> NonFiniteObservationError:
    """Return an error that names the first environment that is not sound, and when it was."""
    copy = int(np.flatnonzero(~sound)[0])
    return NonFiniteObservationError(
        f"{env.goal_spec.name}: environment {copy} shows what is not finite in step "
        f"{int(info['elapsed_steps'][copy])} of its episode, after action {actions[copy].tolist()}"
    )
