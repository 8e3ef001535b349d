"""A program that shows frames from its standard input in a window; it imports nothing of midway.

    python viewer.py WIDTH HEIGHT RATE TITLE

A process of its own, because a window's drawing context and one without a display, as pictures of
the simulation need, do not get along in one. Without arguments it only tries the display. Exit
status 2, and a line on standard error, where there is none.
"""

import sys
import time
from typing import Any

import glfw
import numpy as np
from jaxtyping import UInt8
from OpenGL import GL


def main(arguments: list[str]) -> None:
    """Show the frames until the last one, or until the window is closed or Esc pressed."""
    glfw.ERROR_REPORTING = "exception"
    try:
        if not glfw.init():
            sys.exit(2)
        if arguments:
            width, height, rate = map(int, arguments[:3])
            glfw.window_hint(glfw.RESIZABLE, glfw.FALSE)
            window = glfw.create_window(width, height, arguments[3], None, None)
            glfw.make_context_current(window)
            play(window, width, height, rate)
    except glfw.GLFWError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    finally:
        glfw.terminate()


def play(window: Any, width: int, height: int, rate: int) -> None:
    """Show one frame after the other, at the rate at most."""
    due = time.perf_counter()
    while len(pixels := sys.stdin.buffer.read(width * height * 3)) == width * height * 3:
        draw(window, np.frombuffer(pixels, np.uint8).reshape(height, width, 3))
        due = max(due + 1 / rate, time.perf_counter())
        while (left := due - time.perf_counter()) > 0:
            glfw.wait_events_timeout(left)
        glfw.poll_events()
        escaped = glfw.get_key(window, glfw.KEY_ESCAPE) == glfw.PRESS
        if escaped or glfw.window_should_close(window):
            return


def draw(window: Any, frame: UInt8[np.ndarray, "height width 3"]) -> None:
    """Fill the window with a frame, whatever the display's scale."""
    width, height = glfw.get_framebuffer_size(window)
    GL.glViewport(0, 0, width, height)
    GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
    GL.glRasterPos2f(-1, -1)
    GL.glPixelZoom(width / frame.shape[1], height / frame.shape[0])
    upwards = np.ascontiguousarray(frame[::-1])
    GL.glDrawPixels(frame.shape[1], frame.shape[0], GL.GL_RGB, GL.GL_UNSIGNED_BYTE, upwards)
    glfw.swap_buffers(window)


if __name__ == "__main__":
    main(sys.argv[1:])
