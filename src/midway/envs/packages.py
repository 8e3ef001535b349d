"""Packages of goal environments that are found by the ids alone, if they are installed."""

import importlib.util
import re
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from midway.envs.goals_in_info import GoalsInInfo
from midway.types import OwnEnv

PACKAGES = {
    "gymnasium_robotics": r"(PointMaze|AntMaze|Fetch|Hand|Adroit|FrankaKitchen)",
    "panda_gym": r"Panda",
    "ogbench": r"(visual-)?(pointmaze|antmaze|humanoidmaze|antsoccer|cube|scene|puzzle)-",
    "highway_env": r"(parking|highway|merge|roundabout|intersection|racetrack)",
}
"""How the ids of each package begin."""


def load_for(gym_id: str, import_module: Callable[[str], Any]) -> None:
    """Import the known package that registers this id, where there is one."""
    package = _package(gym_id)
    if package is not None and importlib.util.find_spec(package) is not None:
        import_module(package)


def hint(gym_id: str) -> str | None:
    """Return what to install for an id; nothing where that is not known or not what is missing."""
    package = _package(gym_id)
    if package is None or importlib.util.find_spec(package) is not None:
        return None
    return f"pip install {package.replace('_', '-')}"


def adapted(gym_id: str, env: OwnEnv) -> OwnEnv:
    """Return an environment with its goal in the observation, where its package has it in info."""
    if _package(gym_id) != "ogbench":
        return env
    # In its mazes success is measured on x and y, which come first.
    return GoalsInInfo(env, (0, 1) if "maze-" in gym_id else ())


def fit_to_mujoco() -> None:
    """Let gymnasium-robotics 1.4.2 understand the joint types of MuJoCo 3.16 and later.

    It asks whether a joint type (a NumPy integer) is in a tuple of MuJoCo's constants, which is
    always false there: every Fetch and Hand environment would stop with a bare AssertionError.
    """
    utils: Any = sys.modules.get("gymnasium_robotics.utils.mujoco_utils")
    if utils is None:
        return
    import mujoco

    if np.int32(3) in (mujoco.mjtJoint.mjJNT_HINGE,):
        return
    names = ("mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE")
    numbers = {name: int(getattr(mujoco.mjtJoint, name)) for name in names}
    fitting = types.ModuleType("mujoco")
    vars(fitting).update(vars(mujoco), mjtJoint=types.SimpleNamespace(**numbers))
    utils.mujoco = fitting


def _package(gym_id: str) -> str | None:
    for package, beginning in PACKAGES.items():
        if re.match(beginning, gym_id):
            return package
    return None
