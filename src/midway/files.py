"""Files that are there whole or not at all, and checksums that tell when they were changed."""

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from midway.errors import ConfigurationError

UNFINISHED = ".new"
"""Ending of a file that is being written; it stays behind where the process is killed."""

SEAL = "sha256"
"""Name of the checksum among the values that it was computed from."""


def write(path: Path, content: bytes) -> None:
    """Write a file that is there whole or not at all.

    Raises:
        OSError: It cannot be written; the file is as it was.
    """
    temporary = path.with_name(path.name + UNFINISHED)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):  # the folder may be gone, or read-only
            temporary.unlink(missing_ok=True)
        raise named(error, path) from error


def named(error: OSError, path: Path) -> OSError:
    """Return the error with the name of the file that it happened to."""
    return OSError(error.errno, f"cannot be written: {error.strerror or error}", str(path))


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parsed(text: str) -> Any:
    """Return what JSON text holds.

    Raises:
        ValueError: It is no JSON, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def sealed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain values with the checksum of them all."""
    return {**values, SEAL: _digest(values)}


def check_seal(values: Mapping[str, Any], name: str | Path) -> None:
    """Check that values are as `sealed` left them; those without a checksum pass.

    Raises:
        ConfigurationError: They were changed; the text has both checksums.
    """
    if SEAL in values and values[SEAL] != (found := _digest(values)):
        raise ConfigurationError(
            f"{name} is damaged, or was changed by hand: SHA-256 {short(found)}, "
            f"expected {short(values[SEAL])}"
        )


def short(digest: object) -> str:
    """Return the beginning of a checksum, for messages."""
    return str(digest)[:12]


def _digest(values: Mapping[str, Any]) -> str:
    rest = {name: value for name, value in values.items() if name != SEAL}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()
