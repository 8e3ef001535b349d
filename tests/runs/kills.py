"""A small run that is killed before each of its file operations, one after the other.

``python tests/runs/kills.py`` is the long form: every operation; ``--every N``: fewer. What is
killed must go on, by the same command or ``midway resume``, to the files of a run that was not.
"""

import csv
import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import midway
from midway.cli.main import main as midway_main
from midway.files import UNFINISHED
from midway.runs import complete
from midway.runs.folder import RunFolder
from midway.training.checkpoint import Checkpoints

CHANGES: dict[str, object] = {
    "hidden": (8,),
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 16,
    "replay_capacity": 2_000,
    "evaluate_every": 24,
    "evaluation_episodes": 1,
    "log_every": 8,
    "checkpoint_every": 16,
    "steps": 48,
}
STEPS = 48

OPERATIONS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "fsync")
"""Events of Python that change files, besides opening them to write."""

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


# --- what is watched ------------------------------------------------------------------------------


def before_each_operation(run: Path, act: Callable[[int, str], None]) -> None:
    """Call ``act`` with number and name of each operation on files of a run, before it is done."""
    numbers, lock, fsync = itertools.count(1), threading.RLock(), os.fsync
    busy = threading.local()

    def note(event: str, path: str) -> None:
        if getattr(busy, "here", False) or not Path(path).is_relative_to(run):
            return
        with lock:
            busy.here = True
            act(next(numbers), f"{event} {os.path.relpath(path, run)}")
            busy.here = False

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str) and arguments[2] & WRITING:
            note(event, os.path.abspath(arguments[0]))
        elif event in OPERATIONS:
            path, folder = os.fsdecode(arguments[0]), arguments[-1]
            inside = event in ("os.remove", "os.rmdir") and isinstance(folder, int) and folder >= 0
            base = os.readlink(f"/proc/self/fd/{folder}") if inside else os.getcwd()
            note(event, os.path.join(base, path))

    def noted_fsync(number: int) -> None:
        note("fsync", os.readlink(f"/proc/self/fd/{number}"))
        fsync(number)

    os.fsync = noted_fsync  # type: ignore[assignment]
    sys.addaudithook(hook)


def train(run: Path) -> None:
    """Train as the command line does."""
    settings = [f"{name}={value}" for name, value in CHANGES.items()]
    midway_main(["train", "point-u", "--agent", "sac", "--out", str(run), "--set", *settings])


def trace(run: Path, states: Path) -> None:
    """Train, and keep the run folder as it is before each operation: ``states/NUMBER``."""

    def keep(number: int, name: str) -> None:
        if run.exists():
            shutil.copytree(run, states / f"{number:04}")
        else:
            (states / f"{number:04}").mkdir()
        with (states / "names").open("a") as file:
            file.write(f"{number:04} {name}\n")

    states.mkdir()
    before_each_operation(run, keep)
    train(run)


def kill_at(run: Path, number: int) -> None:
    """Train until an operation, and end by SIGKILL before it."""

    def end(found: int, name: str) -> None:
        if found == number:
            os.kill(os.getpid(), signal.SIGKILL)

    before_each_operation(run, end)
    train(run)


def in_child(*words: object) -> int:
    """Do ``trace RUN STATES`` or ``kill RUN NUMBER`` in a process of its own; return its status."""
    command = [sys.executable, __file__, *map(str, words)]
    return subprocess.run(command, capture_output=True, check=False).returncode


# --- what must be ---------------------------------------------------------------------------------


def go_on(run: Path) -> None:
    """Continue a run that was killed; begin it again where it has no configuration yet."""
    if (run / "config.json").exists():
        assert midway.resume(run).finished
    else:
        assert midway.train("point-u", agent="sac", out=run, changes=CHANGES).finished


def content(run: Path) -> dict[str, object]:
    """Return what must be equal in two runs: names of files, weights, tables without times.

    Each process has a file of events.
    """
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    found: dict[str, object] = {"names": {n for n in names if not n.startswith("events/")}}
    found |= {path.name: path.read_bytes() for path in run.rglob("*.safetensors")}
    for table in ("metrics.csv", "evaluation.csv"):
        with (run / table).open(newline="") as file:
            rows = list(csv.DictReader(file))
        found[table] = [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]
    return found


def difference(whole: Path, run: Path) -> str:
    """Return the first thing that is not as in the whole run; nothing if all is."""
    expected, found = content(whole), content(run)
    for name, value in expected.items():
        if found.get(name) != value:
            return f"{name}: {str(found.get(name))[:300]}, expected {str(value)[:300]}"
    return ""


def check_state(whole: Path, run: Path) -> None:
    """Check what is said of a run that was killed: a whole checkpoint to go on from, or none.

    It is finished only if all of its last step is there.
    """
    folder = RunFolder(run)
    if not folder.config_file.exists():
        folder.prepare()
        return
    chosen = Checkpoints(folder.checkpoints, folder.owner(folder.load_config())).choose()
    assert chosen in (None, 16, 32, 48)
    if not complete.missing(folder, STEPS):
        folder.remove_unfinished()
        assert not difference(whole, run)


def torn(state: Path, later: Path) -> Iterable[Path]:
    """Yield the state with each file that grows until the next one there in part, one by one.

    A file that gets its name by being renamed is there at once.
    """
    for path in sorted(path for path in later.rglob("*") if path.is_file()):
        here = state / path.relative_to(later)
        old, new = (file.read_bytes() if file.exists() else b"" for file in (here, path))
        grows = here.exists() or UNFINISHED in str(path.relative_to(later))
        if grows and len(new) > len(old) and new.startswith(old):
            here.parent.mkdir(parents=True, exist_ok=True)
            here.write_bytes(new[: (len(old) + len(new)) // 2])
            yield state
            here.write_bytes(old)


def kill_and_go_on(whole: Path, run: Path, number: int) -> str:
    """Kill a run before an operation and continue it; return what is wrong with it then."""
    if (status := in_child("kill", run, number)) != -signal.SIGKILL:
        return f"ended by {status}"
    check_state(whole, run)
    go_on(run)
    return difference(whole, run)


def main(every: int) -> int:
    """Kill at every so many operations; return 1 if a run did not go on to the same files."""
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        whole, states = Path(folder) / "whole", Path(folder) / "states"
        in_child("trace", whole, states)
        names = (states / "names").read_text().splitlines()
        print(f"{len(names)} operations")
        for line in names[::every]:
            run = Path(folder) / line[:4]
            wrong = kill_and_go_on(whole, run, int(line[:4]))
            faults += bool(wrong)
            print(line, wrong or "went on", flush=True)
            shutil.rmtree(run, ignore_errors=True)
    return min(faults, 1)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["trace", run, states]:
            trace(Path(run), Path(states))
        case ["kill", run, number]:
            kill_at(Path(run), int(number))
        case [] | ["--every", _] as given:
            sys.exit(main(int(given[1]) if given else 1))
        case _:
            sys.exit(__doc__)
