"""Goal environments that are not midway's, stepped together by their own simulators.

Training rewards them as the paper does: -1 on every step, until the goal is reached by the rule
that ``describing.py`` has found.
"""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Int, Shaped

from midway.envs import deciding
from midway.envs.describing import Foreign
from midway.envs.group import Group
from midway.envs.reading import readings
from midway.envs.simulation import num_cores
from midway.envs.success import judge
from midway.envs.vector import Array, GoalVectorEnv
from midway.envs.workers import Answer, LostError, Workers
from midway.errors import (
    BrokenEnvironmentError,
    ConfigurationError,
    NonFiniteObservationError,
)
from midway.types import Info, NamedValues, Observations, Options, Step

CHEAP_SECONDS = 0.002
"""Environments whose steps take less time together are stepped without other processes."""
CONTRADICTIONS = 3
"""So many moments in which info contradicts the rule are no matter of rounding."""


class ForeignVectorEnv(GoalVectorEnv):
    """Environments that are not midway's, stepped together in a few processes.

    Their simulators cannot be saved: after ``midway resume`` all begin new episodes. Info has
    ``failed``: where the environment ended its episode without success, for which ``step`` returns
    terminated too; ``is_success`` tells them apart. What cuts an episode short is truncated.

    An environment that raises or shows what is not finite is replaced when it is reset. The error
    that names it holds what the others show.

    Args:
        foreign: The environment.
        num_envs: Number of environments.
        task: ``uniform``: the environment's own distribution of starts and goals.
        num_threads: Processes that step; 1: this one alone; 0 chooses. Results do not depend on it.
        render_mode: Gymnasium's, such as ``rgb_array``: ``render`` then returns pictures.

    Raises:
        ConfigurationError: The environment cannot be made, or ``num_envs`` is not positive.
    """

    resumable = False

    def __init__(
        self,
        foreign: Foreign,
        num_envs: int = 1,
        task: str = "uniform",
        num_threads: int = 0,
        render_mode: str | None = None,
    ) -> None:
        self.foreign = foreign
        made = judge(foreign.source)
        read = readings(foreign.spec.name, made.observation_space)
        state = read.get("desired_state")
        shown, goal = (_as_float32(read[name].box()) for name in ("observation", "desired_goal"))
        self._adds_goal = shown.shape != foreign.spec.observation_shape
        if self._adds_goal:
            low, high = (
                np.concatenate(ends) for ends in ((shown.low, goal.low), (shown.high, goal.high))
            )
            shown = spaces.Box(low, high, dtype=np.float32)
        super().__init__(
            foreign.spec,
            num_envs,
            ("uniform",),
            task,
            shown,
            goal,
            state_box=None if state is None else _as_float32(state.box()),
        )
        self.render_mode = render_mode
        make_group = functools.partial(
            Group,
            foreign.source,
            (made.observation_space, made.action_space),
            total=num_envs,
            max_episode_steps=foreign.spec.max_episode_steps,
            action_bound=foreign.settings.action_bound,
            render_mode=render_mode,
        )
        count = self._num_processes(num_threads)
        self._group = make_group(first=0, size=num_envs) if count == 1 else None
        self._workers = (
            None
            if count == 1
            else Workers(make_group, num_envs, count, foreign.settings.step_seconds)
        )
        self._held: dict[str, Array] = {}
        self._newest: Observations = {}
        self._contradictions = 0
        self._resting = np.zeros(num_envs, np.bool_)
        self._broken = np.zeros(num_envs, np.bool_)
        self._fault: BrokenEnvironmentError | None = None
        self._episodes = np.zeros(num_envs, np.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Options | None = None
    ) -> tuple[Observations, Info]:
        """Start new episodes, as `GoalVectorEnv.reset`.

        Raises:
            BrokenEnvironmentError: As `step`; those that broke have no episode.
        """
        shown = super().reset(seed=seed, options=options)
        self._ended |= self._broken
        if self._fault is not None:
            raise self._fault
        return shown

    def rest(self, mask: Bool[Array, " num_envs"]) -> Observations:
        """Step these no more until they are reset: simulators of others can be slow.

        They show what they last showed, and their episodes have no further ends.
        """
        self._resting |= mask
        self._ended &= ~mask
        return self._newest

    def step(self, actions: Array) -> Step:
        """Move every environment by one step, as `GoalVectorEnv.step`.

        Raises:
            ConfigurationError: The environment's info contradicts its rule of success.
            NonFiniteObservationError: What it observes is not finite.
            BrokenEnvironmentError: It raises, hangs, ends its process, or observes something else
                than its space.
        """
        observations, reward, _, truncated, info = super().step(actions)
        reached, ended = info["is_success"], self._held["terminated"] == 1
        # What its info calls success ends no episode as a failure, whatever the rule of the user.
        failed = ended & ~reached & (self._held["word"] != 1) & ~truncated
        truncated = truncated | (self._held["truncated"] == 1) | (ended & ~reached & ~failed)
        awake = ~self._resting
        truncated, failed = truncated & awake, failed & awake
        terminated = (reached | failed) & awake
        self._ended = terminated | truncated
        everyone = info["_is_success"]
        info |= {"failed": failed.copy(), "_failed": everyone.copy()}
        if self._fault is not None:
            truncated = truncated | self._broken
            self._ended |= self._broken
            info |= {"broken": self._broken.copy(), "_broken": everyone.copy()}
            self._fault.copies = np.flatnonzero(self._broken).tolist()
            self._fault.step = (observations, reward, terminated, truncated, info)
            raise self._fault
        return observations, reward, terminated, truncated, info

    def success_pair(self, observations: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return what success is measured on: as exactly as the environment knows it, if newest."""
        if observations is not self._newest:
            return super().success_pair(observations)
        kind = "goal" if self.goal_spec.state_shape is None else "state"
        return self._held[f"achieved_{kind}"], self._held[f"desired_{kind}"]

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of each environment; only with a render mode and one process."""
        return tuple(self._group.render()) if self._group and self.render_mode else None

    def close_extras(self, **kwargs: object) -> None:
        """End the processes and close the environments."""
        if getattr(self, "_workers", None) is not None:
            self._workers.close()  # type: ignore[union-attr]
        if getattr(self, "_group", None) is not None:
            self._group.close()  # type: ignore[union-attr]

    def _begin(self, copies: Int[Array, " n"], options: Options) -> None:
        mask, seeds = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.int64)
        for copy in copies:
            mask[copy], seeds[copy] = True, self.generators[copy].integers(2**31)
        self._resting &= ~mask
        self._episodes[copies] += 1
        self._ask(lambda workers: workers.reset(mask, seeds), {"mask": mask, "seeds": seeds}, None)

    def _advance(self, actions: Shaped[Array, "num_envs action_dim"]) -> None:
        actions = np.where(self._resting[:, None], np.nan, actions).astype(np.float32)
        self._ask(lambda workers: workers.step(actions), None, actions)

    def _ask(
        self,
        ask: Callable[[Workers], Answer],
        options: NamedValues | None,
        actions: Array | None,
    ) -> None:
        """Reset by options, or step by actions, and keep what the environments show.

        Raises:
            BrokenEnvironmentError: A process does not answer, or has ended.
        """
        if self._workers is not None:
            try:
                shown, raised = ask(self._workers)
            except LostError as lost:
                self._ended[:] = True
                error = self._named(lost.copies[0], actions, str(lost))
                error.copies = range(self.num_envs) if actions is None else lost.copies
                raise error from lost
        else:
            assert self._group is not None
            answer = (
                self._group.reset(options=options) if actions is None else self._group.step(actions)
            )
            said = json.loads(answer[-1].get("raised", "{}"))
            shown, raised = answer[0], {int(copy): text for copy, text in said.items()}
        self._hold(shown, raised, actions)

    def _named(self, copy: int, actions: Array | None, what: str) -> BrokenEnvironmentError:
        """Return an error that says which environment broke, and when."""
        episode = self._episodes[copy]
        when = f"in the reset of its episode {episode}"
        if actions is not None:
            step, action = int(self._elapsed[copy]) + 1, actions[copy].tolist()
            when = f"in step {step} of its episode {episode}, after action {action}"
        return BrokenEnvironmentError(f"{self.goal_spec.name}: environment {copy}, {when}: {what}")

    def _hold(
        self, shown: Mapping[str, Array], raised: Mapping[int, str], actions: Array | None
    ) -> None:
        """Keep what the environments show, apart from the memory that they share.

        Those that broke show what they last showed.
        """
        before, self._held = self._held, {name: batch.copy() for name, batch in shown.items()}
        self._broken = self._held["broken"] == 1
        self._fault = None
        for copy, text in raised.items():
            self._fault = self._fault or self._named(copy, actions, text)
        for name in self.single_observation_space:
            batch = self._held[name]
            if batch.dtype == np.uint8:
                continue
            sound = np.isfinite(batch.reshape(self.num_envs, -1)).all(1)
            if not sound.all() and self._fault is None:
                named = self._named(
                    int(np.flatnonzero(~sound)[0]), actions, f"{name} is not finite"
                )
                self._fault = NonFiniteObservationError(str(named))
            self._broken |= ~sound
        for name, batch in self._held.items():
            batch[self._broken] = before[name][self._broken] if before else 0

    def _observe(self) -> Observations:
        boxes: Any = self.single_observation_space
        self._newest = {name: self._held[name].astype(box.dtype) for name, box in boxes.items()}
        if self._adds_goal:
            parts = self._newest["observation"], self._newest["achieved_goal"]
            self._newest["observation"] = np.concatenate(parts, axis=1)
        return self._newest

    def _info(
        self, achieved: Array, desired: Array, reached: Array, mask: Bool[Array, " num_envs"]
    ) -> NamedValues:
        reached = self._as_it_says(achieved, desired, reached)
        return super()._info(achieved, desired, reached, mask)

    def _as_it_says(self, achieved: Array, desired: Array, reached: Array) -> Array:
        """Return success as the environment's info says, where the rule is the environment's.

        Raises:
            ConfigurationError: Info contradicts the rule.
        """
        word = self._held["word"]
        if not self.foreign.rule_is_its_own:
            return reached
        wrong = (word >= 0) & (word != reached)
        self._contradictions += int(wrong.sum())
        if self._contradictions >= CONTRADICTIONS:
            copy = int(np.flatnonzero(wrong)[0]) if wrong.any() else 0
            distance = float(np.linalg.norm(achieved[copy] - desired[copy]))
            raise ConfigurationError(
                f"{self.goal_spec.name}: its info says success {bool(word[copy])} at distance "
                f"{distance:.4g}, but a goal counts as reached {self.foreign.rule.description}: "
                f"success is not a matter of the two goals alone; {deciding.REMEDY}"
            )
        return np.where(word >= 0, word == 1, reached)

    def _num_processes(self, wanted: int) -> int:
        """Return how many processes step; 1: this one alone."""
        together = self.foreign.seconds * self.num_envs
        if self.num_envs == 1 or self.render_mode or (wanted == 0 and together < CHEAP_SECONDS):
            return 1
        return min(wanted or num_cores(), self.num_envs)


def _as_float32(box: spaces.Box) -> spaces.Box:
    dtype: Any = np.uint8 if box.dtype == np.uint8 else np.float32
    return spaces.Box(box.low.astype(dtype), box.high.astype(dtype), dtype=dtype)
