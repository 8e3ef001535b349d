"""Videos of a policy with the subgoals that it imagines on its way."""

import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE
from typing import Any, Protocol, TypeAlias, runtime_checkable

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from PIL import Image

from midway.envs import registry as environments
from midway.envs.mazes import Maze
from midway.reports import imagination, maps, style
from midway.reports.rollouts import Recording, record
from midway.reports.runs import read
from midway.reports.study import POSITION, maze_of
from midway.training import policy as policies
from midway.training.policy import Policy
from midway.types import ConfigurationError

Frame: TypeAlias = UInt8[np.ndarray, "height width 3"]

SECONDS = 8
"""How long a long episode takes in the video; short ones are shown at the lowest rate."""

RATES = {".mp4": (10, 25), ".gif": (10, 15)}
"""Lowest and highest number of frames per second, by file name ending."""

HOLD = 0.8
"""How long the end of an episode stays (s)."""

PIXELS = 100
"""Pixels per inch of a frame."""

SUBGOALS = 20
"""Imagined subgoals at each step."""

GIF_COLOURS = 64


@runtime_checkable
class Scene(Protocol):
    """Draws the frames of one episode; all frames of a video have the same size."""

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        ...


def watch(path: Path, out: Path | None, task: str, episodes: int, seed: int) -> Path:
    """Write a video of a trained policy with mean actions.

    Args:
        path: The run folder.
        out: The file, ``.mp4`` or ``.gif``; default: ``videos/TASK.mp4`` in the run folder.
        task: ``hard``, ``uniform`` or a named case of the environment.
        episodes: Number of episodes, one after the other.
        seed: Seed of starts and goals.

    Returns:
        The file.

    Raises:
        ConfigurationError: The folder, task, number or file cannot be used.
    """
    run = read(path)
    out = out or run.folder.path / "videos" / f"{task}.mp4"
    if out.suffix not in RATES:
        raise ConfigurationError(f"{out}: a video is named {' or '.join(RATES)}")
    if episodes < 1:
        raise ConfigurationError(f"episodes {episodes}: must be at least 1")
    maze = maze_of(run.config.env)
    if maze is None:
        raise ConfigurationError(f"{run.config.env}: videos are made of mazes only")
    policy = policies.load(run.folder, environments.make_vec(run.config.env).goal_spec)
    recordings = record(policy, {task: episodes}, seed)
    longest = max(recording.length for recording in recordings)
    rate = int(np.clip(longest / SECONDS, *RATES[out.suffix]))
    stride = max(1, round(longest / SECONDS / rate))
    title = f"{run.config.agent.upper()} on {run.config.env}, {task}"
    frames = (
        frame
        for recording in recordings
        for frame in _frames(MazeScene(maze, title, policy, recording), recording, stride, rate)
    )
    write(out, frames, rate)
    return out


def write(path: Path, frames: Iterator[Frame], rate: int) -> None:
    """Write frames as MP4 or GIF, by the file name; the file is there whole or not at all.

    Args:
        path: The file, ``.mp4`` or ``.gif``.
        frames: Pictures of one size, with even sides.
        rate: Frames per second.

    Raises:
        ConfigurationError: The file cannot be written.
    """
    writers: dict[str, Callable[..., None]] = {".mp4": _write_mp4, ".gif": _write_gif}
    temporary = path.with_name(f".{path.stem}-new{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            writers[path.suffix](temporary, frames, rate)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigurationError(f"cannot write the video {path}: {reason}") from error


def _write_mp4(path: Path, frames: Iterator[Frame], rate: int) -> None:
    """Pipe the frames to ffmpeg; imageio's own writer would fork, which JAX's threads forbid."""
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate), "-i", "-"]
    command += ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    with subprocess.Popen([*command, str(path)], stdin=PIPE, stderr=PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with suppress(BrokenPipeError):  # it has ended early and says why
            for frame in chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())
        _, words = ffmpeg.communicate()
    if ffmpeg.returncode != 0:
        raise OSError(" ".join(words.decode(errors="replace").split()) or "ffmpeg failed")


def _write_gif(path: Path, frames: Iterator[Frame], rate: int) -> None:
    images = (Image.fromarray(frame).quantize(GIF_COLOURS) for frame in frames)
    first = next(images)
    duration = round(1000 / rate)
    first.save(path, save_all=True, append_images=images, duration=duration, loop=0)


def _frames(scene: Scene, recording: Recording, stride: int, rate: int) -> Iterator[Frame]:
    """Yield every ``stride``-th frame, and the last one for a while."""
    for step in range(0, recording.length, stride):
        yield scene.frame(step)
    last = scene.frame(recording.length)
    for _ in range(max(1, round(HOLD * rate))):
        yield last


class MazeScene:
    """A maze from above, with the agent, its trail, its goal and the subgoals it imagines.

    Walls and words are drawn once; each frame adds what moves.

    Args:
        maze: The maze.
        title: What is shown.
        policy: The policy, asked for subgoals in every state if it imagines any.
        recording: The episode.
    """

    def __init__(self, maze: Maze, title: str, policy: Policy, recording: Recording) -> None:
        self._recording = recording
        self._path = recording.achieved[:, POSITION]
        self._subgoals = _imagined(policy, recording)
        self._distances = policy.state.spec.task.distance(recording.achieved, recording.goal)
        ends = self._path[0], recording.goal[POSITION]
        self._figure, self._artists = _stage(maze, title, *ends, self._subgoals is not None)
        self._canvas: Any = self._figure.canvas
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        trail, agent, subgoals, words = self._artists
        trail.set_data(*self._path[: step + 1].T)
        agent.set_data(*self._path[step : step + 1].T)
        if self._subgoals is not None:
            subgoals.set_data(*self._subgoals[step].T)
        words.set_text(self._words(step))
        self._canvas.restore_region(self._background)
        for artist in self._artists:
            self._figure.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        height, width = (side - side % 2 for side in pixels.shape[:2])
        return pixels[:height, :width].copy()

    def _words(self, step: int) -> str:
        reached = step == self._recording.length and self._recording.success
        end = "goal reached" if reached else f"{self._distances[step]:.1f} m to the goal"
        return f"step {step}, {end}"


def _imagined(policy: Policy, recording: Recording) -> Float[np.ndarray, "T I 2"] | None:
    """Return positions of the subgoals in every state (m); None if the agent has none."""
    if recording.plans is not None:
        last = recording.plans[-1:]
        return np.concatenate([recording.plans, last])[..., POSITION]
    if not imagination.imagines(policy.config.agent):
        return None
    goals = np.repeat(recording.goal[None], len(recording.observations), axis=0)
    drawn = imagination.subgoals(policy, recording.observations, goals, SUBGOALS)
    return drawn[..., POSITION]


def _stage(
    maze: Maze,
    title: str,
    start: Float[np.ndarray, "2"],
    goal: Float[np.ndarray, "2"],
    subgoals: bool,
) -> tuple[Any, Sequence[Any]]:
    """Return the figure with all that stands still, and what moves: trail, agent, subgoals, words.

    The words stand above the map.
    """
    figure, (axes,) = maps.panels(maze, 1)
    figure.set_dpi(PIXELS)
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
    axes.set_title(f"{title}\n", fontsize=style.TEXT, color=style.INK)
    maps.draw_ends(axes, start, goal, size=1.4)
    diamonds: dict[str, Any] = {
        "marker": "D",
        "color": maps.SUBGOAL,
        "markeredgecolor": "none",
        "alpha": 0.7,
    }
    moving: list[Artist] = [
        *axes.plot([], [], color=style.BLUE, linewidth=2, zorder=4),
        *axes.plot([], [], "o", color=style.BLUE, markersize=11, zorder=7),
        *axes.plot([], [], linestyle="", markersize=6, zorder=6, **diamonds),
        axes.text(
            0.5, 1.0, "", transform=axes.transAxes, ha="center", va="bottom", color=style.INK
        ),
    ]
    for artist in moving:
        artist.set_animated(True)
    agent = Line2D([], [], color=style.BLUE, marker="o", markersize=9, linewidth=2, label="agent")
    style.legend_below(figure, [agent, *maps.ends_legend(), *_subgoals_entry(subgoals)])
    return figure, moving


def _subgoals_entry(subgoals: bool) -> list[Line2D]:
    """Return the entry of the imagined subgoals, if there are any."""
    words = "imagined subgoals"
    mark = Line2D([], [], color=maps.SUBGOAL, marker="D", linestyle="", label=words)
    return [mark] if subgoals else []
