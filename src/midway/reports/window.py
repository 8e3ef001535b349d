"""A window that frames are shown in, where a display exists."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE

from midway.reports.scenes import Frame
from midway.types import ConfigurationError

# Without -P the modules beside the program would hide those of Python's library.
PROGRAM = (sys.executable, "-P", str(Path(__file__).with_name("viewer.py")))

RENDERING = ("PYOPENGL_PLATFORM", "MUJOCO_GL")
"""Variables that this process may have set to draw without a display."""


def check() -> None:
    """Try the display.

    Raises:
        ConfigurationError: There is none; the text is one line that says why.
    """
    tried = subprocess.run(PROGRAM, capture_output=True, env=_environment())
    if tried.returncode != 0:
        raise _no_display(tried.stderr)


def play(frames: Iterator[Frame], rate: int, title: str) -> None:
    """Show frames until the last one, or until the window is closed or Esc pressed.

    Args:
        frames: Pictures of one size.
        rate: Frames per second, at most.
        title: Title of the window.

    Raises:
        ConfigurationError: No window can be opened.
    """
    first = next(frames)
    height, width = first.shape[:2]
    command = [*PROGRAM, str(width), str(height), str(rate), title]
    with subprocess.Popen(command, stdin=PIPE, stderr=PIPE, env=_environment()) as viewer:
        assert viewer.stdin is not None
        with suppress(BrokenPipeError):  # the window was closed
            for frame in chain([first], frames):
                viewer.stdin.write(frame.tobytes())
        _, words = viewer.communicate()
    if viewer.returncode != 0:
        raise _no_display(words)


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in RENDERING}


def _no_display(words: bytes) -> ConfigurationError:
    """Return the error with the last line that the viewer said."""
    lines = words.decode(errors="replace").strip().splitlines() or ["it cannot be opened"]
    return ConfigurationError(f"--live needs a display, and there is none here: {lines[-1]}")
