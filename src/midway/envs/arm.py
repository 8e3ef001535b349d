"""The Sawyer arm: joints and inertias of the original robot, drawn with shapes of our own.

The chain stands at the origin and looks along y. A hand pose fixes six of its seven joints; gravity
decides about the seventh: the arm sinks to one side until its second joint rests on its upper
limit. With the elbow on the side of +x it then stays so wherever in the workspace the hand goes.
So that joint is taken as given, and the six others follow from the hand.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from midway.errors import ConfigurationError

JOINT_DAMPING = 10.0
"""Damping of every joint (N m s/rad)."""

HAND_HEIGHT = 0.06
"""Height of the hand (m), the middle of fingers that reach 5 cm further down and up."""

HAND_QUATERNION = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
"""Rotation (w, x, y, z) of a hand whose fingers point down."""

HAND_ROTATION = np.array(((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)))
"""The same as a matrix."""

RESTING_ANGLES = (0.486, -0.5, 1.636, 2.636, 1.883, -1.168, 1.679)
"""Joint angles (rad) with the hand at x 0, y 0.6: where the search for other angles begins."""

RESTING_JOINT = 1
"""The joint that stays on its limit."""

MAX_ITERATIONS = 20
TOLERANCE = 1e-9
"""Error of the hand's position (m) and rotation (rad) at which the search ends."""

DRAWN = 'contype="0" conaffinity="0" mass="0"'
"""Attributes of a shape that is seen but neither touches nor weighs anything."""

ARM_COLOUR = "0.65 0.1 0.1 0.3"
"""Red, and so transparent that the puck shows through the arm."""

HAND_COLOUR = "0.15 0.95 0.15 1"


class Link(NamedTuple):
    """A link of the arm, which turns about the z axis of its own frame.

    Attributes:
        name: Name of the link and of its joint.
        position: Origin in the parent's frame (m).
        quaternion: Rotation in the parent's frame (w, x, y, z).
        joint_range: Limits of the joint (rad).
        mass: Mass (kg).
        centre: Centre of mass (m).
        inertia: Principal moments of inertia (kg m2).
        inertia_quaternion: Rotation of the principal axes.
        radius: Radius that it is drawn with (m).
    """

    name: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    joint_range: tuple[float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]
    inertia_quaternion: tuple[float, float, float, float]
    radius: float


LINKS = (
    Link(
        "l0",
        (0.0, 0.0, 0.08),
        (1.0, 0.0, 0.0, 0.0),
        (-3.0503, 3.0503),
        5.3213,
        (0.024366, 0.010969, 0.14363),
        (0.0651588, 0.0510944, 0.0186218),
        (0.894823, 0.00899958, -0.170275, 0.412573),
        0.06,
    ),
    Link(
        "l1",
        (0.081, 0.05, 0.237),
        (0.5, -0.5, 0.5, 0.5),
        (-3.8, -0.5),
        4.505,
        (-0.0030849, -0.026811, 0.092521),
        (0.0224339, 0.0221624, 0.0097097),
        (0.424888, 0.891987, 0.132364, -0.0794296),
        0.06,
    ),
    Link(
        "l2",
        (0.0, -0.14, 0.1425),
        (0.707107, 0.707107, 0.0, 0.0),
        (-3.0426, 3.0426),
        1.745,
        (-0.00016044, -0.014967, 0.13582),
        (0.0257928, 0.025506, 0.00292515),
        (0.707831, -0.0524761, 0.0516007, 0.702537),
        0.05,
    ),
    Link(
        "l3",
        (0.0, -0.042, 0.26),
        (0.707107, -0.707107, 0.0, 0.0),
        (-3.0439, 3.0439),
        2.5097,
        (-0.0048135, -0.0281, -0.084154),
        (0.0102404, 0.0096997, 0.00369622),
        (0.902999, 0.385391, -0.0880901, 0.168247),
        0.045,
    ),
    Link(
        "l4",
        (0.0, -0.125, -0.1265),
        (0.707107, 0.707107, 0.0, 0.0),
        (-2.9761, 2.9761),
        1.1136,
        (-0.0018844, 0.0069001, 0.1341),
        (0.0136549, 0.0135493, 0.00127353),
        (0.803612, 0.031257, -0.0298334, 0.593582),
        0.03,
    ),
    Link(
        "l5",
        (0.0, 0.031, 0.275),
        (0.707107, -0.707107, 0.0, 0.0),
        (-2.9761, 2.9761),
        1.5625,
        (0.0061133, -0.023697, 0.076416),
        (0.00474131, 0.00422857, 0.00190672),
        (0.404076, 0.9135, 0.0473125, 0.00158335),
        0.022,
    ),
    Link(
        "l6",
        (0.0, -0.11, 0.1053),
        (0.0616248, 0.06163, -0.704416, 0.704416),
        (-4.7124, 4.7124),
        0.3292,
        (-8.0726e-06, 0.0085838, -0.0049566),
        (0.000360258, 0.000311068, 0.000214974),
        (0.479044, 0.515636, -0.513069, 0.491322),
        0.02,
    ),
)
"""The links from the base to the hand."""

HAND_POSITION = (0.0, 0.0, 0.0245)
"""Origin of the hand in the frame of the last link (m)."""

HEAD = """
<body name="head" pos="0 0 0.2965">
  <inertial mass="1.5795" pos="0.0053207 -2.6549e-05 0.1021"
            diaginertia="0.0118334 0.00827089 0.00496574"
            quat="0.999993 7.08405e-05 -0.00359857 -0.000626247"/>
</body>"""
"""The head, which is part of the first link and out of sight."""


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(str(value) for value in values)


def _hand_mjcf(contact: str) -> str:
    """Return the hand: a block and two fingers, with a grip around them to be seen by."""
    finger = f'<geom type="box" size="0.05 0.005 0.005" rgba="{HAND_COLOUR}"'
    finger += f' friction="0.001 0.005 0.0001" {contact}/>'
    return f"""
    <body name="hand" pos="{_numbers(HAND_POSITION)}" quat="0.707107 0 0 0.707107">
      <body name="claw" quat="-0.707107 0 0.707107 0">
        <geom name="claw" type="box" size="0.01 0.04 0.01" rgba="{HAND_COLOUR}"
              friction="1 0.005 0.001" {contact}/>
        <geom name="grip" type="capsule" size="0.02" fromto="0.02 0.0175 0 -0.02 0.0175 0"
              rgba="{HAND_COLOUR}" {DRAWN}/>
        <body name="right-finger" pos="0.01 0.015 0">{finger}</body>
        <body name="left-finger" pos="0.01 0.02 0">{finger}</body>
      </body>
    </body>"""


def arm_mjcf(contact: str) -> str:
    """Return the arm as MJCF, with these attributes of the geoms of the hand.

    Only the hand touches anything. Angles are in radians.
    """
    body, end = _hand_mjcf(contact), HAND_POSITION
    for link in reversed(LINKS):
        body = f"""
        <body name="{link.name}" pos="{_numbers(link.position)}" quat="{_numbers(link.quaternion)}">
          <inertial mass="{link.mass}" pos="{_numbers(link.centre)}"
                    diaginertia="{_numbers(link.inertia)}"
                    quat="{_numbers(link.inertia_quaternion)}"/>
          <joint name="{link.name}" axis="0 0 1" range="{_numbers(link.joint_range)}"
                 limited="true" damping="{JOINT_DAMPING}" armature="0.1"/>
          <geom name="{link.name}" type="capsule" fromto="0 0 0 {_numbers(end)}"
                size="{link.radius}" rgba="{ARM_COLOUR}" {DRAWN}/>
          {HEAD if link.name == "l0" else ""}
          {body}
        </body>"""
        end = link.position
    return f'<body name="base">{body}</body>'


class Arm:
    """Finds the joint angles of the arm of a model.

    Args:
        model: A model that holds ``arm_mjcf``.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        joints = [model.joint(link.name) for link in LINKS]
        self.addresses = np.array([joint.qposadr[0] for joint in joints])
        """Where the joint angles are in ``qpos``."""
        self.hand = model.body("left-finger").id
        """The body whose position is that of the hand."""
        self._model = model
        self._data = mujoco.MjData(model)
        self._moved = np.delete(np.arange(len(LINKS)), RESTING_JOINT)
        self._dofs = np.array([joint.dofadr[0] for joint in joints])[self._moved]
        self._jacobian = np.zeros((6, model.nv))

    def angles(self, position: Float[np.ndarray, "2"]) -> Float[np.ndarray, "7"]:
        """Return the joint angles (rad) at which the hand is at this x-y (m), fingers down.

        Raises:
            ConfigurationError: The arm does not reach there.
        """
        angles = np.array(RESTING_ANGLES)
        for _ in range(MAX_ITERATIONS):
            error = self._error(angles, position)
            if np.abs(error).max() < TOLERANCE:
                return angles
            angles[self._moved] += np.linalg.solve(self._jacobian[:, self._dofs], error)
        raise ConfigurationError(f"hand position {position.tolist()}: out of the arm's reach")

    def _error(
        self, angles: Float[np.ndarray, "7"], position: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "6"]:
        """Return how far (m) and about what (rad) the hand has to move, and set the Jacobian."""
        self._data.qpos[self.addresses] = angles
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_jacBody(
            self._model, self._data, self._jacobian[:3], self._jacobian[3:], self.hand
        )
        shift = np.array((*position, HAND_HEIGHT)) - self._data.xpos[self.hand]
        turn = HAND_ROTATION @ self._data.xmat[self.hand].reshape(3, 3).T
        axis = (turn - turn.T)[(2, 0, 1), (1, 2, 0)] / 2
        return np.concatenate([shift, axis])
