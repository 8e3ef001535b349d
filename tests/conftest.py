"""Settings of every test: what is compiled, kept in memory, waited for and skipped."""

import gc
import os
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import pytest

from midway.training.compilation import give_back_memory, use_compilation_cache

# LLVM's optimisations are most of the time of compiling, and no program of a test is large enough
# to win it back; the emitters that write even the smallest operation in MLIR are half of the rest.
# XLA ends the process at a flag that it does not know, and later releases have no other emitters.
# The processes that tests start compile alike: their results are compared.
CHEAP = {"--xla_backend_optimization_level": "0"}
if jax.__version_info__ < (0, 11):
    CHEAP["--xla_cpu_use_fusion_emitters"] = "false"
FLAGS = os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = " ".join(
    [FLAGS, *(f"{flag}={value}" for flag, value in CHEAP.items() if flag not in FLAGS)]
).strip()

# No example is timed: a test's time limit (pyproject.toml) is the only clock.
hypothesis.settings.register_profile(
    "midway", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("midway")

MAY_SKIP = "MIDWAY_TESTS_MAY_SKIP"
"""Environment variable: with ``no``, as in CI, a skipped test fails the session."""

MUCH = 700_000_000
"""Bytes in memory that a worker lets go of its compiled programs at, before the next test."""

A_LITTLE = 100_000_000
"""Bytes that it must have gained since it last did: what stays is not searched again and again."""

kept = [0]
"""Bytes in memory after programs were let go of."""

LONGEST = (
    "training/test_resume.py",
    "reports/test_report.py",
    "training/test_from_images.py",
    "envs/test_foreign.py",
    "agents/test_leap.py",
    "cluster/test_ray.py",
    "test_own_agent.py",
    "training/test_freeze.py",
    "test_cli.py",
    "training/test_devices.py",
    "reports/test_browser.py",
)
"""Files that are begun before all others, so that no worker waits for them at the end."""

peaks = pytest.StashKey[list[int]]()


@pytest.fixture(scope="session", autouse=True)
def compiled_programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile each program once for all workers and for the processes that tests start."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    os.environ["XDG_CACHE_HOME"] = str(folder)
    use_compilation_cache()
    # Even the smallest: operations outside of compiled functions are compiled one by one.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder


@pytest.fixture(scope="module")
def short_episodes() -> Iterator[None]:
    """End the episodes of midway's environments after a few steps, in this process."""
    import short  # Not before the session is set up: types are checked of what is imported later.

    with short.episodes():
        yield


@pytest.fixture(scope="module", autouse=True)
def memory_of_one_file(compiled_programs: Path) -> Iterator[None]:
    """Let go of a file's compiled programs when it is through: they would pile up to GiBs."""
    yield
    let_go()


@pytest.fixture(autouse=True)
def memory_of_one_test() -> Iterator[None]:
    """Let go of compiled programs inside a file as well, where it has become much."""
    yield
    if resident() > max(MUCH, kept[-1] + A_LITTLE):
        let_go()


def resident() -> int:
    """Return the bytes that this process has in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def let_go() -> None:
    """Free all compiled programs; those that are needed again come from the session's cache."""
    jax.clear_caches()
    gc.collect()
    give_back_memory()
    kept[:] = [resident()]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the files; workers take them in this order with ``--no-loadscope-reorder``."""
    place = {Path(__file__).parent / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(LONGEST)))


def pytest_configure(config: pytest.Config) -> None:
    config.stash[peaks] = []


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Collect what a worker said at its end; one that crashed said nothing."""
    node.config.stash[peaks] += getattr(node, "workeroutput", {}).get("peaks", [])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Note the most memory that this process has had, if it ran tests itself."""
    config = session.config
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    if hasattr(config, "workeroutput"):
        config.workeroutput["peaks"] = [peak]
    elif not config.stash[peaks]:
        config.stash[peaks].append(peak)
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped") if reporter else None
    if skipped and os.environ.get(MAY_SKIP) == "no":
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    stats, found = terminalreporter.stats, terminalreporter.config.stash[peaks]
    terminalreporter.write_line(f"most memory of a test process: {max(found)} MiB")
    if stats.get("skipped") and os.environ.get(MAY_SKIP) == "no":
        terminalreporter.write_line("no test may be skipped here, and some were", red=True)
