"""One process at a time: a lock that the system lets go of when its process ends."""

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from midway import files
from midway.errors import ConfigurationError


@contextmanager
def hold(path: Path, name: str) -> Iterator[None]:
    """Hold a lock; its file says who holds it, and is empty when nobody does.

    What a process that died left in the file is overwritten: its lock went with it.

    Args:
        path: The file of the lock.
        name: What is locked, for the message.

    Raises:
        ConfigurationError: Another process holds it, or the file cannot be made.
    """
    try:
        file = path.open("a+")
    except OSError as error:
        raise ConfigurationError(f"{name} cannot be locked: {error.strerror}") from error
    with file:
        if not _take(file):
            raise ConfigurationError(f"{name}: another process trains this run: {_owner(file)}")
        _note(file, json.dumps(_myself()))
        try:
            yield
        finally:
            _note(file, "")


def held(path: Path) -> bool:
    """Return whether a process holds the lock now."""
    if not path.exists():
        return False
    with path.open("a+") as file:
        return not _take(file)


def _take(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _note(file: IO[str], text: str) -> None:
    """Say who holds the lock; on a full disk it is held without saying so."""
    with suppress(OSError):
        file.truncate(0)
        file.write(text)
        file.flush()


def _myself() -> dict[str, object]:
    since = time.strftime("%Y-%m-%d %H:%M:%S %Z")
    return {"pid": os.getpid(), "host": socket.gethostname(), "since": since}


def _owner(file: IO[str]) -> str:
    file.seek(0)
    try:
        owner = files.parsed(file.read())
        return f"pid {owner['pid']} on {owner['host']}, since {owner['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "it does not say which"
