"""A point mass in a maze: the environment on which agents learn in minutes."""

import mujoco
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Float32

from midway.envs.maze_env import MazeVectorEnv, walls_mjcf
from midway.envs.mazes import MAZES, Maze
from midway.envs.vector import Array

STEP_SECONDS = 0.5
SUBSTEPS = 4
MAX_EPISODE_STEPS = 150

BALL_RADIUS = 0.4
"""Radius of the ball (m); it sinks into a wall by up to 0.16 m when it hits one at full speed."""

MAX_SPEED = 1.0
"""Speed along each axis at full action (m/s), so 0.5 m in a step."""

RESPONSE_SECONDS = 0.2
"""Time in which the ball comes within 1/e of the wanted velocity (s)."""


def point_model(maze: Maze) -> mujoco.MjModel:
    """Return the model: a frictionless ball of 1 kg on two slide joints with velocity servos."""
    timestep = STEP_SECONDS / SUBSTEPS
    joints, servos = "", ""
    for name, axis in (("x", "1 0 0"), ("y", "0 1 0")):
        joints += f'<joint name="{name}" type="slide" axis="{axis}"/>'
        servos += f'<velocity joint="{name}" kv="{1 / RESPONSE_SECONDS}"/>'
    # The contacts are as stiff as the timestep allows: the time constant is at least two of them.
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco model="point">
      <option timestep="{timestep}" gravity="0 0 0"/>
      <default>
        <geom condim="1" solref="{2 * timestep} 1"/>
        <velocity ctrllimited="true" ctrlrange="{-MAX_SPEED} {MAX_SPEED}"/>
      </default>
      <worldbody>
        {walls_mjcf(maze, inner="", outer="")}
        <body name="ball">
          {joints}
          <geom name="ball" type="sphere" size="{BALL_RADIUS}" mass="1"/>
        </body>
      </worldbody>
      <actuator>{servos}</actuator>
    </mujoco>""")


class PointMazeVectorEnv(MazeVectorEnv):
    """Point masses in a maze; observation and goal are (x, y, vx, vy), in m and m/s.

    The action is the wanted velocity in x-y as a share of ``MAX_SPEED``. An episode has 150 steps
    of 0.5 s.

    Args:
        maze: ``u``, ``s``, ``pi`` or ``omega``, or a maze.
        num_envs: Number of copies.
        task: A task of the maze.
        num_threads: Threads that simulate, 0 for one per core.
        max_episode_steps: Steps after which an episode is truncated.

    Raises:
        ConfigurationError: An unknown task, or no copies.
    """

    copies_per_thread = 2
    body_radius = BALL_RADIUS

    def __init__(
        self,
        maze: str | Maze,
        num_envs: int = 1,
        task: str = "uniform",
        num_threads: int = 0,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        shape = MAZES[maze] if isinstance(maze, str) else maze
        high = np.array((*shape.arena.high, 2 * MAX_SPEED, 2 * MAX_SPEED), np.float32)
        super().__init__(
            maze=shape,
            model=point_model(shape),
            name=f"point-{shape.name}",
            num_envs=num_envs,
            task=task,
            observation_box=spaces.Box(-high, high),
            max_episode_steps=max_episode_steps,
            substeps=SUBSTEPS,
            num_threads=num_threads,
        )

    def _pose(self, rng: np.random.Generator, position: Float[Array, "2"]) -> Float[Array, "2"]:
        return position

    def _encode(
        self, qpos: Float[Array, "n 2"], qvel: Float[Array, "n 2"]
    ) -> Float32[Array, "n 4"]:
        return np.concatenate([qpos, qvel], axis=1, dtype=np.float32)
