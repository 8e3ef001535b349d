"""Settings of every test."""

import os
from pathlib import Path

import pytest

from midway.training.compilation import use_compilation_cache


@pytest.fixture(scope="session", autouse=True)
def compiled_programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile each program once for the session, and once for the processes that tests start."""
    folder = tmp_path_factory.mktemp("cache")
    os.environ["XDG_CACHE_HOME"] = str(folder)
    use_compilation_cache()
    return folder
