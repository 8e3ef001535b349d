"""Pictures of simulated states without a display: EGL first, then OSMesa.

A drawing context belongs to one thread of one process and cannot cross a fork, so ``draw`` keeps
one for each: any thread may draw, and so may a forked child.
"""

import importlib
import os
import sys
import threading
from functools import cache
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from midway.errors import ConfigurationError

BACKENDS = ("egl", "osmesa")
"""The ways to draw without a display, in the order of trial: MuJoCo's modules of these names.

A choice in the environment variable ``MUJOCO_GL`` is tried before the others.
"""

PACKAGES = "libegl1 libgl1-mesa-dri (or libosmesa6)"
"""The Debian packages that provide them."""

MAX_GEOMS = 100
"""Most shapes in a picture."""

FIELD_OF_VIEW = 45.0
"""Angle that a free camera sees, MuJoCo's default (degrees)."""

DISC_SIZE = np.array([0.5, 0.05, 0.0])
"""Radius and half height of the disc at a goal (m): what counts as reached in mazes."""

DISC_COLOUR = np.array([0.1, 0.7, 0.3, 0.6], np.float32)

UNUSED_EFFECTS = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_FOG,
    mujoco.mjtRndFlag.mjRND_HAZE,
)

_renderers: dict[tuple[int, int, int], "Renderer"] = {}
_lock = threading.Lock()


def backend() -> str:
    """Return which backend draws here, ``egl`` or ``osmesa``, after trying it.

    Raises:
        ConfigurationError: None of them works; the text names the Debian packages to install.
    """
    return _working_backend()[0]


def draw(model: mujoco.MjModel, qpos: Float[np.ndarray, "n nq"]) -> UInt8[np.ndarray, "n h w 3"]:
    """Return what the model's first camera sees in each state, row 0 at the top.

    The model says how large the pictures are (``visual/global/offwidth`` and ``offheight``). It
    is kept for the life of the process, with its renderer.

    Args:
        model: A model with a camera.
        qpos: Joint positions of the states.

    Raises:
        ConfigurationError: No backend works here.
    """
    key = os.getpid(), threading.get_ident(), id(model)
    with _lock:
        if key not in _renderers:
            _renderers[key] = Renderer(model)
    return _renderers[key].draw(qpos)


class Renderer:
    """Draws one model in the thread that made it, without shadows, reflections or sky.

    Args:
        model: A model, which says how large the pictures are.
        camera: What looks at it; default: its first camera.

    Raises:
        ConfigurationError: No backend works here.
    """

    def __init__(self, model: mujoco.MjModel, camera: mujoco.MjvCamera | None = None) -> None:
        width, height = model.vis.global_.offwidth, model.vis.global_.offheight
        self._model = model
        self._data = mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        for effect in UNUSED_EFFECTS:
            self._scene.flags[effect] = 0
        self._options = mujoco.MjvOption()
        self._camera = camera or _first_camera()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._picture = np.empty((height, width, 3), np.uint8)
        self._gl = _working_backend()[1](width, height)
        self._gl.make_current()
        self._context = _drawing_context(model)

    def draw(
        self, qpos: Float[np.ndarray, "n nq"], goals: Float[np.ndarray, "n 2"] | None = None
    ) -> UInt8[np.ndarray, "n h w 3"]:
        """Return a picture of each state, row 0 at the top, with a disc at each goal (m)."""
        pictures = np.empty((len(qpos), *self._picture.shape), np.uint8)
        # Something else may have made its own context the thread's current one.
        with self._gl.as_current():
            for number, positions in enumerate(qpos):
                self._draw_one(positions, None if goals is None else goals[number])
                pictures[number] = self._picture[::-1]
        return pictures

    def _draw_one(
        self, positions: Float[np.ndarray, " nq"], goal: Float[np.ndarray, "2"] | None
    ) -> None:
        self._data.qpos[:] = positions
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._options,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        if goal is not None:
            self._add_disc(goal)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._picture, None, self._viewport, self._context)

    def _add_disc(self, place: Float[np.ndarray, "2"]) -> None:
        disc = self._scene.geoms[self._scene.ngeom]
        kind, position = mujoco.mjtGeom.mjGEOM_CYLINDER.value, np.array([*place, 0.05])
        mujoco.mjv_initGeom(disc, kind, DISC_SIZE, position, np.eye(3).ravel(), DISC_COLOUR)
        self._scene.ngeom += 1


def camera_above(x: float, y: float, half: float) -> mujoco.MjvCamera:
    """Return a camera that looks straight down, on a square of twice this side (m)."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE.value
    camera.lookat[:] = x, y, 0
    camera.azimuth, camera.elevation = 90, -90
    camera.distance = half / np.tan(np.deg2rad(FIELD_OF_VIEW / 2))
    return camera


def _first_camera() -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = 0
    return camera


def _drawing_context(model: mujoco.MjModel) -> mujoco.MjrContext:
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
    return context


@cache
def _working_backend() -> tuple[str, Any]:
    """Return name and context class of the first backend that can draw."""
    # Mesa's own threads do not pay for small pictures, and would be missing after a fork.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    reasons = []
    for name in sorted(BACKENDS, key=lambda name: name != os.environ.get("MUJOCO_GL")):
        # MuJoCo's library looks up the functions of OpenGL by this choice.
        os.environ["MUJOCO_GL"] = name
        try:
            return name, _tried_context_class(name)
        # A missing library shows as any of ImportError, AttributeError, GLError, FatalError, ...
        except Exception as error:
            reasons.append(f"{name}: {' '.join(str(error).split())}")
            _forget_opengl()
    os.environ.pop("MUJOCO_GL")
    raise ConfigurationError(
        "images need OpenGL without a display, and no backend works here: install the Debian "
        f"packages {PACKAGES}; push-state needs none ({'; '.join(reasons)})"
    )


def _tried_context_class(name: str) -> Any:
    """Return the context class of MuJoCo's module of this name after making one of it."""
    context_class = importlib.import_module(f"mujoco.{name}").GLContext
    context = context_class(8, 8)
    context.make_current()
    _drawing_context(mujoco.MjModel.from_xml_string("<mujoco/>")).free()
    context.free()
    return context_class


def _forget_opengl() -> None:
    """Undo the import of PyOpenGL, which settles on one backend when it is first imported."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    for name in list(sys.modules):
        if name.split(".")[0] == "OpenGL" or name in {f"mujoco.{other}" for other in BACKENDS}:
            del sys.modules[name]
