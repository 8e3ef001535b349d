"""Windows, on a virtual display that keeps its screen in a file."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import gymnasium
import numpy as np
import pytest
from jaxtyping import UInt8

from drawing_here import needs_renderer
from midway.envs.window import check_display
from midway.reports import videos

HEIGHT, WIDTH = 480, 640

Pixels: TypeAlias = UInt8[np.ndarray, "height width 3"]
Screen: TypeAlias = Callable[[], Pixels]

pytestmark = pytest.mark.skipif(
    shutil.which("Xvfb") is None, reason="no Xvfb on this machine: apt-get install xvfb to run it"
)


@pytest.fixture
def screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Screen]:
    """Return what gives the pixels of a display; its file ends with rows of B, G, R, unused."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", f"{WIDTH}x{HEIGHT}x24"]

    def pixels() -> Pixels:
        written = (tmp_path / "Xvfb_screen0").read_bytes()[-4 * WIDTH * HEIGHT :]
        return np.frombuffer(written, np.uint8).reshape(HEIGHT, WIDTH, 4)[..., 2::-1]

    with subprocess.Popen([*command, "-fbdir", str(tmp_path)], pass_fds=[write]) as server:
        try:
            os.close(write)
            with os.fdopen(read) as number:
                monkeypatch.setenv("DISPLAY", f":{number.readline().strip()}")
            yield pixels
        finally:
            server.terminate()


def test_the_window_shows_the_frame(screen: Screen) -> None:
    seen: list[Pixels] = []

    def frames() -> Iterator[Pixels]:
        """Yield a picture that is red above and blue below, until it is seen on the screen."""
        picture = np.zeros((150, 201, 3), np.uint8)
        picture[:75, :, 0] = picture[75:, :, 2] = 255
        while not seen or not seen[-1][40, 30].any():
            yield picture
            time.sleep(0.1)
            seen.append(screen())

    check_display()
    videos.play(frames(), 5, "test")
    assert seen[-1][40, 30].tolist() == [255, 0, 0]
    assert seen[-1][120, 30].tolist() == [0, 0, 255]


@needs_renderer
def test_a_registered_environment_draws_itself_for_a_human(screen: Screen) -> None:
    env = gymnasium.make("midway/PushState-v0", render_mode="human")
    drawn = gymnasium.make("midway/PushState-v0", render_mode="rgb_array")
    for each in (env, drawn):
        each.reset(seed=0)
    for _ in range(2):
        for each in (env, drawn):
            each.step(np.ones(2, np.float32))
    picture = drawn.render()
    assert isinstance(picture, np.ndarray)
    assert env.render() is None
    shown = picture.repeat(6, axis=0).repeat(6, axis=1)[:HEIGHT]
    while not np.array_equal(screen()[: len(shown), : shown.shape[1]], shown):
        time.sleep(0.1)
    for each in (env, drawn):
        each.close()
