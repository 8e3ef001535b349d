"""Table, puck and boundary around the arm, and what starts and goals are drawn from.

Lengths in metres; a state is hand x, y and puck x, y. The numbers are those of the original
environment (paper, appendix C) but for the look of things.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from midway.envs.arm import HAND_HEIGHT, HAND_QUATERNION, arm_mjcf
from midway.envs.mazes import Rectangle
from midway.errors import ConfigurationError

TIMESTEP = 0.002
"""Seconds of one simulation step."""

IMAGE_SIZE = 84
"""Rows and columns of an image."""

TABLE = Rectangle(0.0, 0.6, 0.4, 0.2)
"""The table as it is drawn; it has no edge that a puck could fall off."""

HAND_BOX = Rectangle(0.0, 0.6, 0.2, 0.1)
"""Where the hand can be told to go."""

PUCK_BOX = Rectangle(0.0, 0.6, 0.185, 0.085)
"""Where a puck can be placed: 4 mm inside of what the boundary lets it reach."""

PUCK_HEIGHT = 0.017
"""Height of the middle of a puck that lies on the table."""

CLEARANCE = 0.055
"""Least distance of hand and puck in a start or goal: the radii of puck and fingers."""

ROUNDING = 1e-6
"""More than float32 rounding can take from a length on the table (m)."""

MAX_DRAWS = 1000
"""Rounds of random draws before giving up."""

POINTS_PER_DRAW = 8
"""States drawn at once, of which the first that is allowed is taken."""


def _wall_mjcf(x: float, y: float, size: str, euler: str) -> str:
    return (
        f'<geom type="box" pos="{x} {0.6 + y} 0" size="{size}" euler="{euler}" group="4"'
        f' contype="2" conaffinity="0" friction="0.1 0.005 0.0001"/>'
    )


@cache
def push_model() -> mujoco.MjModel:
    """Return the model, which all environments of the process share.

    The puck slides without turning; the original's has an inertia of 1e7 kg m2 to the same end.
    Contacts are those of puck and table, puck and boundary, hand and puck, hand and table. The
    boundary is a bowl of four boxes that lean outwards, which are not drawn.
    """
    walls = "".join(
        [
            _wall_mjcf(-0.24, 0.0, "0.2 0.5 0.01", "0 1.2 0"),
            _wall_mjcf(0.24, 0.0, "0.2 0.5 0.01", "0 -1.2 0"),
            _wall_mjcf(0.0, 0.14, "0.5 0.2 0.01", "1.2 0 0"),
            _wall_mjcf(0.0, -0.14, "0.5 0.2 0.01", "-1.2 0 0"),
        ]
    )
    slides = "".join(
        f'<joint name="puck-{name}" type="slide" axis="{axis}"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    turned = " ".join(str(number) for number in HAND_QUATERNION)
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco model="push">
      <compiler angle="radian"/>
      <option timestep="{TIMESTEP}" iterations="50"/>
      <visual>
        <global offwidth="{IMAGE_SIZE}" offheight="{IMAGE_SIZE}"/>
        <quality shadowsize="0" offsamples="0" numslices="16" numstacks="8"/>
        <headlight ambient="0.5 0.5 0.5" diffuse="0.4 0.4 0.4" specular="0 0 0"/>
      </visual>
      <default>
        <geom solref="0.008 1" solimp="0.95 0.95 0.01" margin="0.001" friction="1 0.005 0.0001"/>
      </default>
      <worldbody>
        <camera name="front" {_camera_mjcf()}/>
        <geom name="table" type="plane" pos="{TABLE.x} {TABLE.y} 0"
              size="{TABLE.half_x} {TABLE.half_y} 1" rgba="0.6 0.6 0.5 1"
              contype="1" conaffinity="0"/>
        {walls}
        <body name="puck" pos="0 0 {PUCK_HEIGHT}">
          {slides}
          <geom name="puck" type="cylinder" size="0.04 0.015" mass="100.1" rgba="0.1 0.1 0.9 1"
                contype="4" conaffinity="3"/>
        </body>
        {arm_mjcf('contype="0" conaffinity="5"')}
        <body name="target" mocap="true" pos="0 0.6 {HAND_HEIGHT}" quat="{turned}"/>
      </worldbody>
      <equality>
        <weld body1="target" body2="left-finger" solref="0.01 1" anchor="0 0 0"
              relpose="0 0 0 1 0 0 0"/>
      </equality>
    </mujoco>""")


def _camera_mjcf(
    aim: tuple[float, float, float] = (0.0, 0.6, 0.02), distance: float = 0.72, down: float = 65
) -> str:
    """Return the place of a camera that looks at ``aim`` (m), ``down`` degrees, from the front."""
    sine, cosine = math.sin(math.radians(down)), math.cos(math.radians(down))
    x, y, z = aim
    return (
        f'pos="{x} {y + distance * cosine} {z + distance * sine}"'
        f' xyaxes="-1 0 0 0 {-sine} {cosine}" fovy="45"'
    )


@dataclass(frozen=True)
class PushTask:
    """A task: the boxes that hand and puck of start and goal are drawn from, uniformly.

    Attributes:
        start_hand: Of the hand at the start.
        start_puck: Of the puck at the start.
        goal_hand: Of the hand at the goal.
        goal_puck: Of the puck at the goal.
        within: Largest distance of hand and puck at the start.
    """

    start_hand: Rectangle = HAND_BOX
    start_puck: Rectangle = PUCK_BOX
    goal_hand: Rectangle = HAND_BOX
    goal_puck: Rectangle = PUCK_BOX
    within: float = math.inf

    def sample(
        self,
        rng: np.random.Generator,
        apart: float,
        start: Float[np.ndarray, "4"] | None = None,
        goal: Float[np.ndarray, "4"] | None = None,
    ) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4"]]:
        """Draw start and goal, of which hand or puck are at least ``apart`` (m) from each other.

        A state that is given is kept as it is; with both given nothing is drawn.

        Raises:
            ConfigurationError: No start and goal are so far apart.
        """
        start_state = self._sample_start(rng) if start is None else start
        goal_state = self._sample_goal(rng) if goal is None else goal
        both_given = start is not None and goal is not None
        for _ in range(MAX_DRAWS):
            if both_given or _distance(start_state, goal_state) >= apart:
                return start_state, goal_state
            if goal is None:
                goal_state = self._sample_goal(rng)
            else:
                start_state = self._sample_start(rng)
        raise ConfigurationError("push: start always at the goal")

    def _sample_start(self, rng: np.random.Generator) -> Float[np.ndarray, "4"]:
        return _sample_state(rng, self.start_hand, self.start_puck, self.within)

    def _sample_goal(self, rng: np.random.Generator) -> Float[np.ndarray, "4"]:
        return _sample_state(rng, self.goal_hand, self.goal_puck, math.inf)


def _distance(first: Float[np.ndarray, "4"], second: Float[np.ndarray, "4"]) -> float:
    """Return the larger of the distances of the hands and of the pucks (m)."""
    return float(np.linalg.norm((first - second).reshape(2, 2), axis=1).max())


def _sample_state(
    rng: np.random.Generator, hand: Rectangle, puck: Rectangle, within: float
) -> Float[np.ndarray, "4"]:
    """Draw a state whose hand and puck do not touch and are ``within`` (m) of each other."""
    for _ in range(MAX_DRAWS):
        low, high = (*hand.low, *puck.low), (*hand.high, *puck.high)
        states = rng.uniform(low, high, (POINTS_PER_DRAW, 4))
        apart = np.linalg.norm(states[:, 2:] - states[:, :2], axis=1)
        allowed = (apart >= CLEARANCE) & (apart <= within)
        if allowed.any():
            return np.asarray(states[allowed.argmax()])
    raise ConfigurationError(f"push: hand in {hand} always too near to a puck in {puck}")


def possible(states: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
    """Return whether hand and puck can be placed so, but for rounding."""
    hand, puck = states[:, :2], states[:, 2:]
    clear = np.linalg.norm(puck - hand, axis=1) >= CLEARANCE - ROUNDING
    in_place = HAND_BOX.grown(ROUNDING).contains(hand) & PUCK_BOX.grown(ROUNDING).contains(puck)
    return np.asarray(clear & in_place)


TASKS: Mapping[str, PushTask] = MappingProxyType(
    {
        "uniform": PushTask(),
        "hard": PushTask(
            start_hand=Rectangle(0.175, 0.675, 0.025, 0.025),
            start_puck=Rectangle(-0.125, 0.575, 0.025, 0.025),
            goal_hand=Rectangle(-0.175, 0.525, 0.025, 0.025),
            goal_puck=Rectangle(0.1675, 0.6675, 0.0175, 0.0175),
        ),
        "near": PushTask(within=0.075),
    }
)
"""``uniform`` (the paper's training), ``hard`` (its test) and ``near``: as ``uniform``, but the
puck starts beside the hand, as in the training of the original code. The goal's puck of ``hard``
is the part of the original's box [0.15, 0.20] x [0.65, 0.70] that a puck can reach."""
