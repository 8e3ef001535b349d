"""Weights & Biases as a callback; nothing is sent unless a project is named."""

import hashlib
from typing import Any

from midway.errors import needing
from midway.runs.callbacks import Callback, Event


class Wandb:
    """Shows every row and evaluation of a run to a project of Weights & Biases.

    A run that is resumed goes on under the same name there.

    Args:
        project: The project.

    Raises:
        ConfigurationError: The package is not installed.
    """

    def __init__(self, project: str) -> None:
        with needing("wandb", f"--wandb {project}"):
            import wandb
        self._wandb: Any = wandb
        self._project = project
        self._run: Any = None

    def __call__(self, event: Event) -> None:
        """Send a row or evaluations."""
        if self._run is None:
            self._run = self._begin(event)
        values: dict[str, float] = dict(event.metrics)
        for result in event.evaluations:
            name = f"eval/{result.task}/{result.actions}"
            values[f"{name}/success_rate"] = result.success_rate
            values[f"{name}/final_distance"] = result.final_distance
            values[f"{name}/episode_length"] = result.length
        self._run.log({"step": event.step, **values})

    def _begin(self, event: Event) -> Any:
        place = f"{event.path.absolute()} {event.config.identity}"
        run = self._wandb.init(
            project=self._project,
            name=event.path.name,
            id=hashlib.sha256(place.encode()).hexdigest()[:16],
            resume="allow",
            config=event.config.to_json(),
        )
        run.define_metric("step")
        run.define_metric("*", step_metric="step")  # a resumed run repeats none of its own
        return run


def watching(project: str | None) -> list[Callback]:
    """Return the callbacks of a command line that names a project, or none.

    Raises:
        ConfigurationError: The package is not installed.
    """
    return [] if project is None else [Wandb(project)]
