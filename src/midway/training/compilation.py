"""Compiled programs kept between runs."""

import os
from pathlib import Path

import jax


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache, so that the next start of a run is quick."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "midway" / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
