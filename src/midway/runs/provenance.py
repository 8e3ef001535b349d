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
