"""Where a new run goes: a folder that is free, or one whose run is deleted."""

import shutil
from pathlib import Path

from midway.errors import ConfigurationError
from midway.runs.folder import RunFolder, check_format, read_json


def free_folder(path: Path) -> Path:
    """Return the path, or the first with a number behind it where nothing is yet."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}-{number}")
    return free


def clear(folder: RunFolder) -> None:
    """Delete the run in a folder, if there is one; its description goes last.

    Raises:
        ConfigurationError: It holds no run, or another process trains it.
        OSError: Something cannot be deleted.
    """
    if not folder.path.exists() or not folder.strangers():
        return
    if not folder.config_file.exists():
        raise ConfigurationError(f"{folder.path} is no run folder: nothing is overwritten")
    check_format(read_json(folder.config_file), folder.config_file)
    last = folder.lock_file, folder.config_file
    with folder.lock():
        for path in (path for path in folder.path.iterdir() if path not in last):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        folder.config_file.unlink()
