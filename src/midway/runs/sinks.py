"""Where what a run says goes: its folder, the terminal, and those who watch it."""

from collections.abc import Mapping

from midway.runs import kept
from midway.runs import policy as policies
from midway.runs.callbacks import Watchers
from midway.runs.folder import RunConfig, RunFolder
from midway.training import loop, state
from midway.training.checkpoint import Checkpoints
from midway.training.evaluate import Evaluation
from midway.training.logging import Logger
from midway.training.progress import Reporter
from midway.training.state import Training


class RunSinks:
    """Puts what a run says into its folder, and on the terminal.

    Args:
        config: The configuration of the run.
        folder: Its folder.
        logger: Its CSV and TensorBoard files.
        checkpoints: Its checkpoints.
        say: Its terminal.
        watchers: Those who watch it.
    """

    def __init__(
        self,
        config: RunConfig,
        folder: RunFolder,
        logger: Logger,
        checkpoints: Checkpoints,
        say: Reporter,
        watchers: Watchers,
    ) -> None:
        self._config = config
        self._folder = folder
        self._checkpoints = checkpoints
        self.message, self.progress = say.message, say.advance
        self._logger = logger
        self._watchers = watchers
        self._row: Mapping[str, int | float] = {}
        self._results: list[Evaluation] = []

    def metrics(self, step: int, values: dict[str, int | float]) -> None:
        """Write one row of scalars."""
        self._logger.metrics(step, values)
        self._row = values

    def evaluation(self, step: int, clock: loop.Clock, results: list[Evaluation]) -> None:
        """Write a row for each evaluated task and kind of action: all of them, or none."""
        self._logger.evaluation(step, clock, results)
        self._results = results

    def watched(self, training: Training) -> bool:
        """Show what was written last to those who watch; note it where they end the run.

        Nothing ends a run before its first step.
        """
        shown = self._row, self._results
        self._row, self._results = {}, []
        why, step = self._watchers.verdict(training, *shown), training.counters.steps
        if why and 0 < step < training.last_step:
            self._folder.note_end(step)
            self.message(f"ends at step {step}: {why}")
        return bool(why) and step > 0

    def snapshot(self, training: Training) -> None:
        """Keep the weights of this step, for figures."""
        policies.keep(self._folder, self._config, training)

    def is_better(self, result: Evaluation) -> bool:
        """Return whether the lower end of its interval lies above that of the best policy."""
        best = kept.best(self._folder)
        return result.success.low > (0.0 if best is None else best.success.low)

    def best(self, training: Training, confirmed: Evaluation) -> None:
        """Keep the policy as the best."""
        policies.keep_best(self._folder, self._config, training, confirmed)

    def checkpoint(self, training: Training) -> None:
        """Write a checkpoint and the policy.

        Raises:
            NonFiniteError: A network is not finite; nothing is written then.
        """
        loop.check_finite(training)
        stored = state.state_dict(training)
        self._checkpoints.save(training.counters.steps, stored, training.env_spec)
        self.policy(training)

    def policy(self, training: Training) -> None:
        """Write the policy."""
        policies.save(self._folder, self._config, training)
