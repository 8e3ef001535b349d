"""Compiled programs kept between runs, and what the compiler leaves behind."""

import ctypes
import os
from pathlib import Path

import jax


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache, so that the next start of a run is quick."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "midway" / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


def give_back_memory() -> None:
    """Return to the system what was freed: compiling the update leaves hundreds of MiB behind.

    Does nothing where the C library has no such call.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
