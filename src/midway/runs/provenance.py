"""What made a run: versions, commit, machine and command."""

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

from midway.types import JsonObject

PACKAGES = ("midway", "jax", "equinox", "optax", "mujoco", "gymnasium", "numpy")


def provenance() -> JsonObject:
    """Return versions, commit, machine and command."""
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in PACKAGES},
        },
        "commit": _commit(),
        "machine": {"processor": platform.machine(), "cores": len(os.sched_getaffinity(0))},
        "command": _command(),
    }


COMPUTING = ("jax", "mujoco")
"""Packages whose releases may round otherwise."""


def changed_here(record: JsonObject) -> str:
    """Return what here is not as it was where a run went on last, and changes what is computed.

    Args:
        record: What ``config.json`` holds.

    Returns:
        One line; nothing if all is as before.
    """
    last = [record, *record.get("resumed", [])][-1]
    now = provenance()
    compared = [("machine", name) for name in now["machine"]]
    compared += [("versions", name) for name in COMPUTING]
    pairs = {name: (last[part][name], now[part][name]) for part, name in compared}
    differ = [
        f"{name} {was} before, {here} here" for name, (was, here) in pairs.items() if was != here
    ]
    if not differ:
        return ""
    return f"results may differ from those of an uninterrupted run: {', '.join(differ)}"


def _command() -> str:
    """Return the command that this process is, as it is typed; ``python -m midway.cli`` too."""
    program = Path(sys.argv[0])
    name = "midway" if program.name == "__main__.py" else program.name
    return shlex.join([name, *sys.argv[1:]])


def _commit() -> str | None:
    """Return the commit of the source tree that the package runs from, if it is one."""
    try:
        answer = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"],
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
