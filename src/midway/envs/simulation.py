"""Goal vector environments on MuJoCo: all copies are stepped together on a thread pool."""

import os
from collections.abc import Mapping

import mujoco
import numpy as np
from gymnasium import spaces
from jaxtyping import Int, Shaped
from mujoco.batch import Batch

from midway.envs.vector import Array, GoalVectorEnv
from midway.types import EnvSpec, Observations, Options, Step


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


class SimulationVectorEnv(GoalVectorEnv):
    """A goal vector environment whose copies are the simulations of a ``mujoco.batch.Batch``.

    A subclass implements ``_place`` (new starts and goals, written to the batch and ``_goals``)
    and ``_achieved`` (what is observed, from the batch), and ``_apply`` where actions are
    not the model's controls.

    A copy whose simulation diverges stays in the state before the step, and its episode is
    truncated; info ``diverged`` tells.

    Args:
        model: The MuJoCo model of one copy.
        goal_spec: What agents may know of the environment.
        num_envs: Number of copies.
        tasks: Names of the tasks.
        task: The first current task.
        observation_box: Bounds of one observation.
        goal_box: Bounds of one goal.
        state_box: Bounds of the state that success is measured on, where goals are images.
        substeps: Simulation steps for each environment step.
        num_threads: Threads that simulate; 0 for one per core that the process may use, but no
            more than ``copies_per_thread`` justifies. Results do not depend on it.

    Raises:
        ConfigurationError: As ``GoalVectorEnv``.
    """

    copies_per_thread = 1
    """Copies that are worth a thread of their own: more where a step takes microseconds."""

    def __init__(
        self,
        model: mujoco.MjModel,
        goal_spec: EnvSpec,
        num_envs: int,
        tasks: tuple[str, ...],
        task: str,
        observation_box: spaces.Box,
        goal_box: spaces.Box,
        state_box: spaces.Box | None = None,
        substeps: int = 1,
        num_threads: int = 0,
    ) -> None:
        super().__init__(goal_spec, num_envs, tasks, task, observation_box, goal_box, state_box)
        # A simulation that diverges shall show as NaN, not jump to the model's default pose.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        if num_threads == 0:
            num_threads = min(num_cores(), -(-num_envs // self.copies_per_thread))
        self.batch = Batch(model, num_envs, min(num_threads, num_envs))
        self.substeps = substeps
        # These are live views of the simulations' state.
        self._qpos = self.batch.bind("qpos")
        self._qvel = self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._diverged = np.zeros(num_envs, np.bool_)
        self._goals: Observations = {
            name: np.zeros((num_envs, *box.shape), box.dtype)  # type: ignore[arg-type]
            for name, box in self.single_observation_space.items()
            if name.startswith("desired_")
        }

    def _place(self, copies: Int[Array, " n"], options: Options) -> None:
        """Write start states and goals of these copies, whose simulations are at their default."""
        raise NotImplementedError

    def _achieved(self) -> Observations:
        """Return the observations without the desired goals, in newly allocated arrays."""
        raise NotImplementedError

    def _apply(self, actions: Shaped[Array, "num_envs action_dim"]) -> None:
        """Write the actions to the simulations; MuJoCo clips them to the controls' range."""
        self._ctrl[:] = actions

    def _begin(self, copies: Int[Array, " n"], options: Options) -> None:
        self.batch.reset(copies, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._place(copies, options)

    def _simulate(self) -> None:
        """Take one step of the environment in all simulations."""
        self.batch.step(nstep=self.substeps)

    def _advance(self, actions: Shaped[Array, "num_envs action_dim"]) -> None:
        before = self.batch.state.copy()
        self._apply(actions)
        self._simulate()
        moving = np.concatenate([self._qpos, self._qvel], axis=1)
        self._diverged = ~(np.abs(moving) < mujoco.mjMAXVAL).all(1)  # NaN is not below either
        if self._diverged.any():
            self.batch.state[self._diverged] = before[self._diverged]

    def step(self, actions: Array) -> Step:
        """Move every copy by one step, as `GoalVectorEnv.step`."""
        observations, reward, terminated, truncated, info = super().step(actions)
        truncated = truncated | self._diverged
        self._ended |= self._diverged
        info |= {"diverged": self._diverged.copy(), "_diverged": info["_is_success"].copy()}
        return observations, reward, terminated, truncated, info

    def _observe(self) -> Observations:
        return self._achieved() | {name: goal.copy() for name, goal in self._goals.items()}

    def state_dict(self) -> dict[str, Array]:
        """Return all that the future depends on, with the complete state of the simulations."""
        goals = {name: goal.copy() for name, goal in self._goals.items()}
        return super().state_dict() | goals | {"simulation": self.batch.state.copy()}

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Continue from a ``state_dict``, bit for bit.

        Raises:
            ConfigurationError: The state belongs to another environment or number of copies.
        """
        super().load_state_dict(state)
        self.batch.state[:] = state["simulation"]
        for name, goal in self._goals.items():
            goal[:] = state[name]
