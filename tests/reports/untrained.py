"""Saved policies of agents that have learned nothing."""

from midway import api
from midway.runs import policy
from midway.runs.folder import RunConfig, RunFolder
from midway.training import state


def save_untrained(folder: RunFolder, config: RunConfig, steps: int) -> None:
    """Make a run folder with the policy of an agent that has learned nothing."""
    training = state.start(api.setup_of(config, folder))
    training.counters = training.counters._replace(steps=steps)
    folder.create(config)
    policy.save(folder, config, training)
