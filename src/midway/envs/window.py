"""A window that shows pictures; `viewer.py` draws it in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

from jaxtyping import UInt8
from numpy import ndarray

from midway.errors import ConfigurationError

# Without -P the modules beside the program would hide those of Python's library.
VIEWER = (sys.executable, "-P", str(Path(__file__).with_name("viewer.py")))

RENDERING = ("PYOPENGL_PLATFORM", "MUJOCO_GL")
"""Variables that this process may have set to draw without a display."""


class Window:
    """Shows pictures of one size, until it is closed or Esc pressed.

    Args:
        shape: Shape of a picture: rows, columns, 3.
        rate: Pictures per second, at most.
        title: Its title.
    """

    def __init__(self, shape: tuple[int, ...], rate: int, title: str) -> None:
        height, width, _ = shape
        command = [*VIEWER, str(width), str(height), str(rate), title]
        self._viewer = subprocess.Popen(command, stdin=PIPE, stderr=PIPE, env=_environment())

    def show(self, picture: UInt8[ndarray, "height width 3"]) -> bool:
        """Show a picture when those before it have had their time; return whether it is open."""
        assert self._viewer.stdin is not None
        try:
            self._viewer.stdin.write(picture.tobytes())
            self._viewer.stdin.flush()
        except BrokenPipeError:
            return False
        return True

    def close(self) -> None:
        """Close it after the last picture.

        Raises:
            ConfigurationError: It never opened.
        """
        _, words = self._viewer.communicate()
        if self._viewer.returncode != 0:
            raise _no_display(words)


def check_display() -> None:
    """Try the display.

    Raises:
        ConfigurationError: There is none; the text is one line that says why.
    """
    tried = subprocess.run(VIEWER, capture_output=True, env=_environment())
    if tried.returncode != 0:
        raise _no_display(tried.stderr)


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in RENDERING}


def _no_display(words: bytes) -> ConfigurationError:
    """Return the error with the last line that the viewer said."""
    lines = words.decode(errors="replace").strip().splitlines() or ["it cannot be opened"]
    return ConfigurationError(f"a window needs a display, and there is none here: {lines[-1]}")
