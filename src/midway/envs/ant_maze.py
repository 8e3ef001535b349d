"""The four-legged ant in a maze: the navigation tasks of the paper (appendix C).

Every number of the model is that of the original environment.
"""

import math
from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Float32

from midway.envs.maze_env import MazeVectorEnv, walls_mjcf
from midway.envs.mazes import MAZES, Maze
from midway.envs.vector import Array
from midway.types import Observations

TIMESTEP = 0.03
"""Seconds of one simulation step."""

SUBSTEPS = 5
MAX_EPISODE_STEPS = 600

START_HEIGHT = 0.565
"""Height of the torso of a start or goal (m)."""

START_JOINTS = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
"""Hip and ankle angles of legs 1 to 4 of a start or goal (rad)."""

YAWS = (0.0, math.pi, math.pi / 2, -math.pi / 2)
"""The headings of starts and goals (rad)."""

TORSO_RADIUS = 0.25
"""Radius of the torso (m)."""

LEGS = (
    ("front-left", (1, 1), (-1, 1), (30, 70)),
    ("front-right", (-1, 1), (1, 1), (-70, -30)),
    ("back-left", (-1, -1), (-1, 1), (-70, -30)),
    ("back-right", (1, -1), (1, 1), (30, 70)),
)
"""Legs 1 to 4: name, direction in x-y, axis of the ankle in x-y, its range (degrees)."""

ACTUATED_LEGS = (3, 0, 1, 2)
"""Legs in the order of the actions, which starts with the last one."""


def _capsule(name: str, end: tuple[float, float]) -> str:
    return f'<geom name="{name}" type="capsule" size="0.08" fromto="0 0 0 {end[0]} {end[1]} 0"/>'


def _leg_mjcf(
    name: str, direction: tuple[int, int], ankle_axis: tuple[int, int], ankle_range: tuple[int, int]
) -> str:
    """Return a leg: a piece that is part of the torso, a hip segment and a shin."""
    x, y = direction
    upper, shin = (0.2 * x, 0.2 * y), (0.4 * x, 0.4 * y)
    return f"""
    {_capsule(f"{name}-root", upper)}
    <body name="{name}-thigh" pos="{upper[0]} {upper[1]} 0">
      <joint name="{name}-hip" type="hinge" axis="0 0 1" range="-30 30"/>
      {_capsule(f"{name}-thigh", upper)}
      <body name="{name}-shin" pos="{upper[0]} {upper[1]} 0">
        <joint name="{name}-ankle" type="hinge" axis="{ankle_axis[0]} {ankle_axis[1]} 0"
               range="{ankle_range[0]} {ankle_range[1]}"/>
        {_capsule(f"{name}-shin", shin)}
      </body>
    </body>"""


def ant_model(maze: Maze) -> mujoco.MjModel:
    """Return the ant among the walls of a maze (SI units, angles of the model in degrees)."""
    legs = "".join(_leg_mjcf(*leg) for leg in LEGS)
    motors = "".join(
        f'<motor name="{name}" joint="{name}"/>'
        for leg in ACTUATED_LEGS
        for name in (f"{LEGS[leg][0]}-hip", f"{LEGS[leg][0]}-ankle")
    )
    # The contact bits let the ant touch floor and walls but not itself.
    walls = walls_mjcf(
        maze, inner='contype="3" conaffinity="3"', outer='contype="2" conaffinity="3"'
    )
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco model="ant">
      <compiler angle="degree" inertiafromgeom="true"/>
      <option timestep="{TIMESTEP}" integrator="RK4"/>
      <default>
        <joint armature="1" damping="1" limited="true"/>
        <geom density="5" friction="1 0.5 0.5" margin="0.01" condim="3"
              contype="1" conaffinity="0"/>
        <motor gear="10" ctrllimited="true" ctrlrange="-1 1"/>
      </default>
      <worldbody>
        <geom name="floor" type="plane" size="50 50 1" conaffinity="1"/>
        {walls}
        <body name="torso" pos="0 0 {START_HEIGHT}">
          <joint name="root" type="free" armature="0" damping="0" margin="0.01" limited="false"/>
          <geom name="torso" type="sphere" size="{TORSO_RADIUS}"/>
          {legs}
        </body>
      </worldbody>
      <actuator>{motors}</actuator>
    </mujoco>""")


def encode_rotation(quaternion: Float[Array, "n 4"]) -> Float[Array, "n 6"]:
    """Return (-cos yaw, sin yaw, cos pitch, -sin pitch, cos roll, sin roll) of (w, x, y, z).

    The signs are those of the original environment: it takes the quaternion for (x, y, z, w) and
    so gets the angles (pi - yaw, -pitch, roll), whose cosines and sines it observes.
    """
    w, x, y, z = quaternion.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    sin_pitch = np.clip(2 * (w * y - z * x), -1, 1)
    cos_pitch = np.sqrt(1 - sin_pitch**2)
    return np.stack(
        [-np.cos(yaw), np.sin(yaw), cos_pitch, -sin_pitch, np.cos(roll), np.sin(roll)], axis=1
    )


CENTER = (
    *(0.0, 0.0, 0.56, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0),
    *(0.0, 0.86, 0.0, -0.86, 0.0, -0.86, 0.0, 0.86),
)
"""Middle of the entries of an observation before the velocities: upright, ankles half bent."""

SPREAD = (3.3, 3.3, 0.1, 0.7, 0.7, 0.1, 0.15, 0.1, 0.15, *4 * (0.41, 0.3))
SPREAD_OF_VELOCITIES = (0.45, 0.45, 0.4, 0.6, 0.6, 0.7, *4 * (1.57, 1.27))
"""Deviations from it of ants that walk, rounded; x and y in one unit (m, rad, m/s, rad/s)."""


class AntMazeVectorEnv(MazeVectorEnv):
    """Ants in a maze; observation and goal are the same 31 numbers.

    These are the torso's x, y, z (m), six cosines and sines of its rotation
    (``encode_rotation``), hip and ankle angles of legs 1 to 4 (rad), and 14 velocities: the
    torso's linear in the world (m/s) and angular in its own frame (rad/s), the joints' (rad/s).
    The action is the torque of each motor as a share of 10 N m, in the order of ``ACTUATED_LEGS``.
    An episode has 600 steps of 0.15 s.

    Args:
        maze: ``u``, ``s``, ``pi`` or ``omega``, or a maze.
        num_envs: Number of copies.
        task: A task of the maze.
        num_threads: Threads that simulate, 0 for one per core.
        max_episode_steps: Steps after which an episode is truncated.

    Raises:
        ConfigurationError: An unknown task, or no copies.
    """

    body_radius = TORSO_RADIUS
    logged_info: ClassVar[Mapping[str, str]] = {"flipped": "flip_rate"}

    center = (*CENTER, *14 * (0.0,))
    spread = (*SPREAD, *SPREAD_OF_VELOCITIES)

    def __init__(
        self,
        maze: str | Maze,
        num_envs: int = 1,
        task: str = "uniform",
        num_threads: int = 0,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        shape = MAZES[maze] if isinstance(maze, str) else maze
        high = np.full(31, np.inf, np.float32)
        high[3:9] = 1
        super().__init__(
            maze=shape,
            model=ant_model(shape),
            name=f"ant-{shape.name}",
            num_envs=num_envs,
            task=task,
            observation_box=spaces.Box(-high, high),
            max_episode_steps=max_episode_steps,
            substeps=SUBSTEPS,
            num_threads=num_threads,
        )

    def _pose(self, rng: np.random.Generator, position: Float[Array, "2"]) -> Float[Array, "15"]:
        half_yaw = YAWS[rng.integers(len(YAWS))] / 2
        quaternion = (math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw))
        return np.array((*position, START_HEIGHT, *quaternion, *START_JOINTS))

    def _encode(
        self, qpos: Float[Array, "n 15"], qvel: Float[Array, "n 14"]
    ) -> Float32[Array, "n 31"]:
        parts = [qpos[:, :3], encode_rotation(qpos[:, 3:7]), qpos[:, 7:], qvel]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def _own_info(self) -> Observations:
        _, x, y, _ = self._qpos[:, 3:7].T
        # The height of the torso's up axis, which is cos pitch * cos roll.
        return {"flipped": 1 - 2 * (x * x + y * y) < 0}
