"""Collection: one step of every parallel environment into the replay."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from midway.errors import BrokenEnvironmentError, ConfigurationError
from midway.replay.storage import ReplayState
from midway.training import faults, step
from midway.training.archive import Stored
from midway.types import Info, NumPyArray, Observations, Step, VectorGoalEnv

Actions = Callable[[Observations], NumPyArray]


MOST_IN_A_ROW = 10
"""Steps, one after the other, in which environments may break before the run stops after all."""


@dataclass
class EpisodeCounts:
    """What happened since the last row of metrics.

    Attributes:
        episodes: Episodes that ended.
        successes: Those of them that reached their goal.
        length: Their steps.
        diverged: Episodes that were cut because their simulation diverged.
        restarts: Environments that broke and were made anew.
    """

    episodes: int = 0
    successes: int = 0
    length: int = 0
    diverged: int = 0
    restarts: int = 0

    def metrics(self) -> dict[str, float]:
        """Return means over the ended episodes, NaN where none ended, and counts of faults."""
        none = self.episodes == 0
        return {
            "collect/success_rate": math.nan if none else self.successes / self.episodes,
            "collect/episode_length": math.nan if none else self.length / self.episodes,
            "collect/diverged": float(self.diverged),
            "collect/restarts": float(self.restarts),
        }


@dataclass
class Collector:
    """Environments in the middle of their episodes.

    Attributes:
        env: A vector environment without autoreset.
        observation: The newest observations.
        begun: Environments in which the last step was followed by a new episode.
        counts: Episodes that ended since the last row of metrics.
        limit: Steps after which an episode is cut off, if that is before the environment's own; 0
            for never.
        logged: Sum and number over the steps since then of each info that the environment wants
            logged, by its name in ``metrics.csv``.
        restarts: Whether the run goes on where an environment breaks that can be made anew.
        moved: Whether the last step was taken; not if an environment raised in it.
        stored: Whether it gave the replay anything; if not, the replay may be empty.
        fault: What was wrong with an environment in the last step, where the run cannot go on.
        in_a_row: Steps until now, one after the other, in which environments broke.
    """

    env: VectorGoalEnv
    observation: Observations
    begun: NumPyArray
    counts: EpisodeCounts = field(default_factory=EpisodeCounts)
    limit: int = 0
    logged: dict[str, NumPyArray] = field(default_factory=dict)
    restarts: bool = False
    moved: bool = True
    stored: bool = True
    fault: BrokenEnvironmentError | None = None
    in_a_row: int = 0

    def __post_init__(self) -> None:
        """Begin the sums that are not given."""
        self.logged = {name: np.zeros(2) for name in self.env.logged_info.values()} | self.logged

    @staticmethod
    def start(
        env: VectorGoalEnv,
        replay: ReplayState,
        seed: int,
        limit: int = 0,
        restarts: bool = False,
    ) -> tuple["Collector", ReplayState]:
        """Reset every environment and begin its first episode in the replay."""
        observation, _ = env.reset(seed=seed)
        everyone = np.ones(env.num_envs, np.bool_)
        collector = Collector(env, observation, everyone, limit=limit, restarts=restarts)
        return collector, step.begin(replay, observation, everyone)

    def step(self, replay: ReplayState, choose: Actions) -> ReplayState:
        """Take one step in every environment; begin new episodes where one has ended.

        Where an environment breaks, or its simulation diverges, the step is not stored, the steps
        of its episode before are withdrawn, and a new episode begins. Where the run must stop, that
        is noted as ``fault``; a step in which an environment of others breaks is not taken then.
        """
        actions = choose(self.observation)
        self.moved, self.fault = True, None
        try:
            taken = self.env.step(actions)
            self.in_a_row = 0
        except BrokenEnvironmentError as error:
            if not self._goes_on(error) or error.step is None:
                self.moved, self.begun = False, np.full(self.env.num_envs, self.fault is None)
                replay = step.withdraw(replay, self._mask(error))
                return self._begin(replay) if self.fault is None else replay
            taken = cast(Step, error.step)
        return self._store(replay, actions, taken)

    def _store(self, replay: ReplayState, actions: NumPyArray, taken: Step) -> ReplayState:
        observation, _, terminated, truncated, info = taken
        none = np.zeros(self.env.num_envs, np.bool_)
        diverged, broken = info.get("diverged", none), info.get("broken", none)
        sound = faults.finite(observation) & ~diverged & ~broken
        if not (sound | diverged | broken).all():
            self.fault = faults.not_finite(self.env, sound | diverged | broken, info, actions)
        self.observation = observation
        for name, column in self.env.logged_info.items():
            self.logged[column] += (info[name][sound].sum(), int(sound.sum()))
        failed = {"failed": info["failed"]} if "failed" in info else {}
        replay = step.add(replay, actions, self.observation | failed, sound)
        self.stored = bool(sound.any())
        if not sound.all():
            replay = step.withdraw(replay, ~sound)
        ended = terminated | truncated
        if self.limit:
            ended = ended | (info["elapsed_steps"] >= self.limit)
        self._count(ended & sound, info)
        self.counts.diverged += int(diverged.sum())
        self.begun = ended | ~sound
        return self._begin(replay) if self.begun.any() else replay

    def _count(self, ended: NumPyArray, info: Info) -> None:
        self.counts.episodes += int(ended.sum())
        self.counts.successes += int((info["is_success"] & ended).sum())
        self.counts.length += int(info["elapsed_steps"][ended].sum())

    def _goes_on(self, error: BrokenEnvironmentError) -> bool:
        """Return whether the run goes on after an environment broke; note the fault if not."""
        self.in_a_row += 1
        if not self.restarts or self.in_a_row > MOST_IN_A_ROW:
            self.fault = error
            return False
        broken = cast(Step, error.step)[-1]["broken"] if error.step is not None else np.ones(1)
        self.counts.restarts += int(broken.sum())
        return True

    def _begin(self, replay: ReplayState) -> ReplayState:
        """Begin the episodes of ``begun``; where that fails, a resumed run begins all anew."""
        while True:
            try:
                self.observation, _ = self.env.reset(options={"reset_mask": self.begun})
                return step.begin(replay, self.observation, self.begun)
            except BrokenEnvironmentError as error:
                if not self._goes_on(error):
                    return replay
                self.begun = self.begun | self._mask(error)

    def _mask(self, error: BrokenEnvironmentError) -> NumPyArray:
        """Return which environments an error is about."""
        return np.isin(np.arange(self.env.num_envs), error.copies)

    def take_metrics(self) -> dict[str, float]:
        """Return means since the last call, NaN where there are none; then start anew."""
        means = {
            f"collect/{column}": total / steps if steps else math.nan
            for column, (total, steps) in self.logged.items()
        }
        metrics = self.counts.metrics() | means
        self.counts = EpisodeCounts()
        self.logged = {column: np.zeros(2) for column in self.logged}
        return metrics

    def state_dict(self) -> Stored:
        """Return simulators, observations and counts as arrays."""
        return {
            "logged": {name: value.copy() for name, value in self.logged.items()},
            "env": self.env.state_dict(),
            "observation": dict(self.observation),
            "counts": {name: np.array(value) for name, value in vars(self.counts).items()},
        }

    @staticmethod
    def restore(
        env: VectorGoalEnv, replay: ReplayState, state: Stored
    ) -> tuple["Collector", ReplayState]:
        """Return the collector that ``state_dict`` was taken from, on a new environment.

        Where the environment cannot continue its episodes, new ones begin in all of them.

        Raises:
            ConfigurationError: The state is not one of this environment.
        """
        try:
            env.load_state_dict(state["env"])
        except (KeyError, ValueError) as error:
            raise ConfigurationError(
                f"the checkpoint does not fit the environment: {error}"
            ) from error
        counts = EpisodeCounts(**{name: int(value) for name, value in state["counts"].items()})
        logged = {name: np.array(value) for name, value in state["logged"].items()}
        everyone = np.ones(env.num_envs, np.bool_)
        if env.resumable:
            return Collector(
                env, dict(state["observation"]), ~everyone, counts, logged=logged
            ), replay
        observation, _ = env.reset()
        return Collector(env, observation, everyone, counts, logged=logged), step.begin(
            replay, observation, everyone
        )
