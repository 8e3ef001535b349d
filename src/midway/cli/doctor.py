"""What a machine has of what midway uses."""

import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass

from midway.errors import needing

LIBRARIES = ("jax", "equinox", "optax", "mujoco", "gymnasium")


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: What was looked at.
        ok: Whether it works.
        detail: What was found, or what to do about it.
        needed: Whether training on states needs it.
    """

    name: str
    ok: bool
    detail: str
    needed: bool = True


def checks() -> list[Check]:
    """Return every check, in the order in which a user would mend them."""
    return [
        Check("python", sys.version_info >= (3, 11), platform.python_version()),
        _check("libraries", _libraries),
        _check("cores", lambda: f"{len(os.sched_getaffinity(0))} usable"),
        _check("device", _device),
        _check("simulation", _simulation),
        _check("rendering", _rendering, needed=False),
        _check("figures", _figures, needed=False),
        _check("video", _video, needed=False),
    ]


def _check(name: str, look: Callable[[], str], needed: bool = True) -> Check:
    """Return what ``look`` found; whatever goes wrong in it is the finding."""
    try:
        return Check(name, True, look(), needed)
    except Exception as error:
        return Check(name, False, " ".join(str(error).split()), needed)


def _libraries() -> str:
    return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in LIBRARIES)


def _device() -> str:
    import jax

    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"


def _simulation() -> str:
    from midway.envs.registry import make_vec

    env = make_vec("point-u")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    return "point-u steps"


def _rendering() -> str:
    from midway.envs import rendering

    return str(rendering.backend())


def _figures() -> str:
    with needing("plots", "a figure"):
        import matplotlib

    return f"matplotlib {matplotlib.__version__}"


def _video() -> str:
    with needing("video", "a video"):
        import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_version())
