"""The arm that pushes a puck: goals for both, told by images or by four numbers (appendix C)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Float32, Int, Shaped

from midway.envs.arm import Arm
from midway.envs.push_scene import (
    CLEARANCE,
    HAND_BOX,
    IMAGE_SIZE,
    PUCK_BOX,
    ROUNDING,
    TABLE,
    TASKS,
    possible,
    push_model,
)
from midway.envs.rendering import backend, draw
from midway.envs.simulation import SimulationVectorEnv
from midway.envs.vector import Array
from midway.errors import ConfigurationError
from midway.types import DistanceTask, EnvSpec, Observations, Options

SUBSTEPS = 50
"""Simulation steps for each step: 0.1 s."""

ACTION_SCALE = 0.02
"""How far a full action moves the hand's target along each axis (m)."""

GOAL_THRESHOLD = 0.05
"""Distance in x-y below which hand and puck have to be (m); paper, appendix C."""

STATE_BOX = spaces.Box(
    np.array(TABLE.low * 2, np.float32), np.array(TABLE.high * 2, np.float32), dtype=np.float32
)
"""Bounds of hand x, y and puck x, y (m)."""

IMAGE_BOX = spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
"""Bounds of an RGB image, row 0 at the top."""

STATE_SPEC = EnvSpec(
    name="push-state",
    observation_shape=(4,),
    observation_dtype="float32",
    goal_shape=(4,),
    action_dim=2,
    max_episode_steps=100,
    goal_is_observation=True,
    state_shape=None,
    task=DistanceTask(((0, 1), (2, 3)), GOAL_THRESHOLD, names=("hand", "puck")),
    origin=(TABLE.x, TABLE.y) * 2,
    unit=0.1,  # in metres, centimetres that matter are lost beside the biases of the first layers
)

IMAGE_SPEC = replace(
    STATE_SPEC,
    name="push",
    observation_shape=IMAGE_BOX.shape,
    observation_dtype="uint8",
    goal_shape=IMAGE_BOX.shape,
    state_shape=(4,),
    origin=(),
    unit=1.0,
)

POSITIONS = mujoco.mjtStage.mjSTAGE_POS.value


class PushStateVectorEnv(SimulationVectorEnv):
    """Arms with pucks; observation and goal are hand x, y and puck x, y (m).

    The action moves a target along x and y, by ``ACTION_SCALE`` at most; the hand is drawn after
    it. An episode has 100 steps of 0.1 s.

    Args:
        num_envs: Number of copies.
        task: ``uniform``, ``hard`` or ``near``.
        num_threads: Threads that simulate, 0 for one per core.

    Raises:
        ConfigurationError: An unknown task, or no copies.
    """

    option_names = (*SimulationVectorEnv.option_names, "start", "goal")
    spec_of_class: ClassVar[EnvSpec] = STATE_SPEC
    boxes: ClassVar[dict[str, spaces.Box]] = {"observation_box": STATE_BOX, "goal_box": STATE_BOX}

    def __init__(self, num_envs: int = 1, task: str = "uniform", num_threads: int = 0) -> None:
        self.model = push_model()
        super().__init__(
            model=self.model,
            goal_spec=self.spec_of_class,
            num_envs=num_envs,
            tasks=tuple(TASKS),
            task=task,
            substeps=SUBSTEPS,
            num_threads=num_threads,
            **self.boxes,
        )
        self._arm = Arm(self.model)
        self._puck = [self.model.joint(f"puck-{axis}").qposadr[0] for axis in "xy"]
        self._targets = self.batch.bind("mocap_pos")[:, 0, :2]
        self._hands = self.batch.bind("xpos")[:, self._arm.hand, :2]

    def poses(self, states: Float[Array, "n 4"]) -> Float[Array, "n nq"]:
        """Return the joint positions of these states (m), at rest with the fingers down.

        Raises:
            ConfigurationError: The arm does not reach a hand position.
        """
        poses = np.zeros((len(states), self.model.nq))
        poses[:, self._puck] = states[:, 2:]
        for pose, state in zip(poses, states, strict=True):
            pose[self._arm.addresses] = self._arm.angles(state[:2])
        return poses

    def render(self) -> tuple[Shaped[Array, "84 84 3"], ...]:
        """Return a picture of each copy, as `push` observes it.

        Raises:
            ConfigurationError: Nothing here can draw.
        """
        return tuple(draw(self.model, self._qpos))

    def _states(self) -> Float32[Array, "num_envs 4"]:
        return np.concatenate([self._hands, self._qpos[:, self._puck]], axis=1, dtype=np.float32)

    def _achieved(self) -> Observations:
        states = self._states()
        return {"observation": states, "achieved_goal": states.copy()}

    def _apply(self, actions: Shaped[Array, "num_envs 2"]) -> None:
        moved = self._targets + ACTION_SCALE * np.clip(actions, -1, 1)
        self._targets[:] = np.clip(moved, HAND_BOX.low, HAND_BOX.high)

    def _simulate(self) -> None:
        # The stage makes the positions of bodies those of the new state.
        self.batch.step(nstep=self.substeps, stage=POSITIONS)

    def _place(self, copies: Int[Array, " n"], options: Options) -> None:
        given = [self._given(options.get(role), role) for role in ("start", "goal")]
        pairs = [
            TASKS[self.task].sample(
                self.generators[copy],
                GOAL_THRESHOLD + ROUNDING,
                *(states[copy] for states in given),
            )
            for copy in copies
        ]
        starts, goals = (np.stack(states) for states in zip(*pairs, strict=True))
        self._qpos[copies] = self.poses(starts)
        self._targets[copies] = starts[:, :2]
        self.batch.forward(copies, stage=POSITIONS)
        self._set_goals(copies, goals)

    def _set_goals(self, copies: Int[Array, " n"], states: Float[Array, "n 4"]) -> None:
        self._goals["desired_goal"][copies] = states

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Continue from a ``state_dict``, bit for bit.

        Raises:
            ConfigurationError: The state belongs to another environment or number of copies.
        """
        super().load_state_dict(state)
        self.batch.forward(stage=POSITIONS)

    def _given(self, states: object, role: str) -> list[Float[Array, "4"] | None]:
        """Return for each copy the start or goal that the user's options name, if they do.

        Raises:
            ConfigurationError: Hand or puck where they cannot be, or of the wrong shape.
        """
        if states is None:
            return [None] * self.num_envs
        try:
            states = np.broadcast_to(np.asarray(states, np.float64), (self.num_envs, 4))
        except ValueError:
            raise ConfigurationError(
                f"{role} {states!r}: must be hand x, y and puck x, y, or these for each copy"
            ) from None
        for state in states[~possible(states)]:
            raise ConfigurationError(
                f"{role} {state.tolist()}: the hand must be in {HAND_BOX}, the puck in {PUCK_BOX} "
                f"and {CLEARANCE} m from it"
            )
        return list(states)


class PushVectorEnv(PushStateVectorEnv):
    """Arms with pucks as seen by a camera; observation and goal are images.

    Images are 84 x 84 RGB, uint8, row 0 at the top. ``achieved_state`` and ``desired_state`` are
    hand x, y and puck x, y (m), which success is measured on.

    Args:
        num_envs: Number of copies.
        task: ``uniform``, ``hard`` or ``near``.
        num_threads: Threads that simulate, 0 for one per core; one thread draws.

    Raises:
        ConfigurationError: An unknown task, no copies, or nothing here can draw.
    """

    spec_of_class: ClassVar[EnvSpec] = IMAGE_SPEC
    boxes: ClassVar[dict[str, spaces.Box]] = {
        "observation_box": IMAGE_BOX,
        "goal_box": IMAGE_BOX,
        "state_box": STATE_BOX,
    }

    def __init__(self, num_envs: int = 1, task: str = "uniform", num_threads: int = 0) -> None:
        backend()
        super().__init__(num_envs, task, num_threads)
        self._images = np.zeros((num_envs, *IMAGE_BOX.shape), np.uint8)
        self._outdated = np.ones(num_envs, np.bool_)

    def images(self, states: Float[Array, "n 4"]) -> Shaped[Array, "n 84 84 3"]:
        """Return pictures of these states (m), at rest: what goals look like."""
        return draw(self.model, self.poses(states))

    def _achieved(self) -> Observations:
        self._images[self._outdated] = draw(self.model, self._qpos[self._outdated])
        self._outdated[:] = False
        return {
            "observation": self._images.copy(),
            "achieved_goal": self._images.copy(),
            "achieved_state": self._states(),
        }

    def _advance(self, actions: Shaped[Array, "num_envs 2"]) -> None:
        super()._advance(actions)
        self._outdated[:] = True

    def _place(self, copies: Int[Array, " n"], options: Options) -> None:
        super()._place(copies, options)
        self._outdated[copies] = True

    def _set_goals(self, copies: Int[Array, " n"], states: Float[Array, "n 4"]) -> None:
        self._goals["desired_state"][copies] = states
        self._goals["desired_goal"][copies] = self.images(states)

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Continue from a ``state_dict``, bit for bit.

        Raises:
            ConfigurationError: The state belongs to another environment or number of copies.
        """
        super().load_state_dict(state)
        self._outdated[:] = True
