"""Videos of a policy with the subgoals that it imagines on its way, as files or in a window."""

import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE

import numpy as np
from PIL import Image

from midway.envs.window import Window, check_display
from midway.errors import ConfigurationError, needing
from midway.reports import scenes
from midway.reports.recordings import Recording, record
from midway.reports.runs import RunData, agent_labels, read
from midway.reports.scenes import Frame, Scene
from midway.runs import policy as policies
from midway.runs.kept import Which
from midway.training.progress import stage

SECONDS = 8
"""How long a long episode takes in the video; short ones are shown at the lowest rate."""

RATES = {".mp4": (10, 25), ".gif": (10, 15)}
"""Lowest and highest number of frames per second, by file name ending."""

HOLD = 0.8
"""How long the end of an episode stays (s)."""

GIF_COLOURS = 64


def watch(
    path: str | Path,
    out: str | Path | None = None,
    task: str | None = None,
    episodes: int = 1,
    seed: int = 0,
    policy: Which = "last",
    changes: Mapping[str, object] | None = None,
) -> Path:
    """Write a video of a trained policy, which acts deterministically.

    Args:
        path: The run folder.
        out: The file, ``.mp4`` or ``.gif``; default: ``videos/TASK.mp4`` in the run folder.
        task: ``hard``, ``uniform`` or a named case of the environment; None: the hard one, if there
            is one.
        episodes: Number of episodes, one after the other.
        seed: Seed of starts and goals.
        policy: ``last``, ``best``, or a step whose policy was kept.
        changes: Settings that the policy acts with, as in `midway.api.load`.

    Returns:
        The file.

    Raises:
        ConfigurationError: The folder, policy, task, setting, number or file cannot be used.
    """
    run = read(Path(path), policy, changes)
    task = task or run.config.declaration().shown_task
    out = Path(out or run.folder.path / "videos" / f"{task}.mp4")
    if out.suffix not in RATES:
        raise ConfigurationError(f"{out}: a video is named {' or '.join(RATES)}")
    frames, rate = film(run, task, episodes, seed, RATES[out.suffix])
    write(out, frames, rate)
    return out


def show(
    path: str | Path,
    task: str | None = None,
    episodes: int = 1,
    seed: int = 0,
    policy: Which = "last",
    changes: Mapping[str, object] | None = None,
) -> None:
    """Show the same in a window, until the last episode has ended or the window is closed.

    Args:
        path: The run folder.
        task: As in ``watch``.
        episodes: As in ``watch``.
        seed: As in ``watch``.
        policy: As in ``watch``.
        changes: As in ``watch``.

    Raises:
        ConfigurationError: As in ``watch``, or there is no display here.
    """
    run = read(Path(path), policy, changes)
    task = task or run.config.declaration().shown_task
    check_display()
    frames, rate = film(run, task, episodes, seed, RATES[".mp4"])
    play(frames, rate, f"midway: {path}")


def film(
    run: RunData, task: str, episodes: int, seed: int, rates: tuple[int, int]
) -> tuple[Iterator[Frame], int]:
    """Return the frames of episodes of a run's policy, and how many there are in a second.

    Raises:
        ConfigurationError: The folder, task or number cannot be used.
    """
    if episodes < 1:
        raise ConfigurationError(f"episodes {episodes}: must be at least 1")
    policy = policies.load(run.folder, run.weights).using(run.changes)
    (label,) = agent_labels([run.config.agent])
    title = f"{label} on {run.config.env}, {task}"
    make = scenes.maker(run.folder, policy, title)
    foreign = run.config.declaration().foreign
    recordings = record(policy, {task: episodes}, seed, draw=bool(foreign and foreign.draws))
    longest = max(recording.length for recording in recordings)
    rate = int(np.clip(longest / SECONDS, *rates))
    stride = max(1, round(longest / SECONDS / rate))

    def frames() -> Iterator[Frame]:
        for number, recording in enumerate(recordings):
            stage("episode in the video", number, len(recordings))
            yield from _frames(make(recording), recording, stride, rate)

    return frames(), rate


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
    with needing("video", f"the video {path.name}"):
        import imageio_ffmpeg
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
    with closing(Window(first.shape, rate, title)) as window:
        for frame in chain([first], frames):
            if not window.show(frame):
                return
