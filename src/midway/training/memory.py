"""Memory that a run takes for sure, against what the machine has."""

from pathlib import Path

import equinox as eqx
import jax

from midway.errors import ConfigurationError
from midway.replay.storage import num_bytes

GROUP = Path("/sys/fs/cgroup")
SYSTEM = Path("/proc/meminfo")
GB = 1e9
ABSURD = 10**300
"""Bytes beyond which there is no floating-point number to print."""
GROUP_FILES = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    (
        "memory/memory.limit_in_bytes",
        "memory/memory.usage_in_bytes",
        "memory/memory.stat",
        "total_inactive_file",
    ),
)
"""Limit, use, statistics and the name of cached files in them: of version 2 and 1."""


def available(group: Path = GROUP, system: Path = SYSTEM) -> int | None:
    """Return the bytes that this process may still take; None where nobody says."""
    found = [free for free in (_of_system(system), _of_group(group)) if free is not None]
    return min(found, default=None)


def check(parts: dict[str, int]) -> None:
    """Check that what is about to be allocated fits.

    Accelerators have memory of their own, and say themselves when it is full.

    Args:
        parts: Bytes by what they are for.

    Raises:
        ConfigurationError: It does not fit.
    """
    needed, free = sum(parts.values()), available()
    if free is None or needed <= free or jax.default_backend() != "cpu":
        return
    listed = ", ".join(f"{name} {_gigabytes(size)}" for name, size in parts.items())
    raise ConfigurationError(
        f"the run needs at least {_gigabytes(needed)} of memory ({listed}), and "
        f"{_gigabytes(free)} are available"
    )


def _gigabytes(size: int) -> str:
    return f"{min(size, ABSURD) / GB:.3g} GB"


def of_state(state: object) -> int:
    """Return the bytes of an agent's state, optimisers included, or of its shapes."""
    return num_bytes(eqx.filter(state, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct)))


def _of_system(file: Path) -> int | None:
    try:
        lines = dict(line.split(":", 1) for line in file.read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError, IndexError):
        return None


def _of_group(folder: Path) -> int | None:
    """Return what the limit of the control group leaves, without files that are only cached."""
    for limit, used, stat, cached in GROUP_FILES:
        try:
            rows = (line.split() for line in (folder / stat).read_text().splitlines())
            free = int((folder / limit).read_text()) - int((folder / used).read_text())
            return max(0, free + int(dict(rows).get(cached, 0)))
        except (OSError, ValueError):  # no such group, or no limit: "max"
            continue
    return None
