"""A sweep on a local Ray cluster whose driver, a worker and a node are killed one by one."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tiny
from midway import tables
from midway.cluster import sweep
from midway.configuration import configure
from midway.errors import ConfigurationError
from midway.runs import complete
from midway.runs.folder import RunFolder, write_json
from midway.training.arrays import save_arrays
from midway.training.checkpoint import steps_in

pytestmark = [
    pytest.mark.extra,
    pytest.mark.timeout(1800),
    # Ray leaves sockets and files of its own processes to the garbage collector.
    pytest.mark.filterwarnings("ignore"),
]

SETTINGS = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 3,
    "health_check_timeout_ms": 60_000,
    "enable_worker_prestart": False,
    "prestart_worker_first_driver": False,
    "worker_niceness": 0,
}
"""A node that is gone is found out in two seconds; one that is slow is none that is gone.

Workers are as nice as other processes: on a busy machine they would get nothing.
"""

STAND_IN = """
import os, pathlib, shutil, sys, time
words, home = sys.orig_argv, pathlib.Path(os.environ["STAND_IN"])
if words[1:3] == ["-m", "midway.cli"] and words[3] in ("train", "resume"):
    run = pathlib.Path(words[words.index("--out") + 1] if words[3] == "train" else words[4])
    seed = run.name[-1]
    with (home / f"starts{seed}").open("a") as file:
        file.write(f"{words[3]} {os.getpid()}\\n")
    if seed == "2":
        print("midway: its simulator is tired", flush=True)
        os._exit(1)
    run.mkdir(exist_ok=True)
    shutil.copy(home / "whole" / "config.json", run)
    while not (home / f"go{seed}").exists():
        time.sleep(0.05)
    shutil.copytree(home / "whole", run, dirs_exist_ok=True)
    os._exit(0)
"""
"""In the place of `midway train` and `resume`: notes its start, waits, and leaves a whole run."""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the stand-ins, which all processes of the cluster start."""
    (tmp_path / "sitecustomize.py").write_text(STAND_IN)
    monkeypatch.setenv("STAND_IN", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    whole = RunFolder(tmp_path / "whole")
    whole.create(configure("point-u", "sac", "quick", 0, {"steps": 40}))
    (whole.checkpoints / "40").mkdir(parents=True)
    tables.write(whole.evaluation_file, {"step": np.array([40])})
    save_arrays(whole.policy_weights, {"weight": np.zeros(1)}, {"step": 40})
    write_json(whole.policy_config, {"step": 40})
    return tmp_path


@contextmanager
def started(processors: int) -> Iterator[Any]:
    """Start a cluster of a head with so many processors."""
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": processors, "include_dashboard": False, "_system_config": SETTINGS}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@pytest.fixture
def cluster(home: Path) -> Iterator[Any]:
    """A head with one processor, whose runs are stand-ins."""
    with started(1) as cluster:
        yield cluster


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait for what is sure to come; how long it may take is the time limit of the test."""
    while not condition():
        time.sleep(0.02)


def starts(home: Path, seed: int) -> list[tuple[str, int]]:
    """Return command and process of each start of a run."""
    file = home / f"starts{seed}"
    lines = file.read_text().splitlines() if file.exists() else []
    return [(line.split()[0], int(line.split()[1])) for line in lines]


def is_running(process: int) -> bool:
    """Return whether a process has a command line: one that has ended has none."""
    try:
        return bool(Path(f"/proc/{process}/cmdline").read_bytes())
    except OSError:
        return False


def parent(process: int) -> int:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("PPid:")).split()[1])


def test_a_sweep_outlives_its_driver_a_worker_and_a_node(cluster: Any, home: Path) -> None:
    node = cluster.add_node(num_cpus=1)
    out = home / "sweep"
    words = [sys.executable, "-m", "midway.cli", "sweep", "point-u", "--agents", "sac"]
    driver = subprocess.Popen([*words, "--seeds", "0", "--out", out, "--ray", cluster.address])
    wait_for(lambda: starts(home, 0) or driver.poll() is not None)
    driver.kill()
    driver.wait()
    (first,) = starts(home, 0)
    wait_for(lambda: not is_running(first[1]))

    ended: list[sweep.Status] = []
    jobs = sweep.jobs(["point-u"], ["sac"], [0, 1, 2])
    address = cluster.address
    typed_again = threading.Thread(
        target=lambda: ended.extend(sweep.run(jobs, out, lambda found: None, ray_address=address)),
        daemon=True,
    )
    typed_again.start()
    wait_for(lambda: (len(starts(home, 0)), len(starts(home, 1))) == (2, 1))
    raylet = node.all_processes["raylet"][0].process.pid
    workers = {seed: parent(starts(home, seed)[-1][1]) for seed in (0, 1)}
    (seed,) = (seed for seed, worker in workers.items() if parent(worker) == raylet)

    before = len(starts(home, seed))
    os.kill(workers[seed], signal.SIGKILL)
    wait_for(lambda: len(starts(home, seed)) == before + 1)
    cluster.remove_node(node, allow_graceful=False)
    wait_for(lambda: not is_running(starts(home, seed)[-1][1]))
    (home / f"go{1 - seed}").touch()  # which frees the processor of the head
    wait_for(lambda: len(starts(home, seed)) == before + 2)
    (home / f"go{seed}").touch()
    typed_again.join()
    assert [status.state for status in ended] == ["finished", "finished", "failed"]
    assert ended[2].reason == "midway: its simulator is tired"
    for each in (0, 1):
        commands = [command for command, _ in starts(home, each)]
        assert commands == ["train"] + ["resume"] * (len(commands) - 1)


def test_a_run_whose_worker_and_node_are_killed_ends_with_the_same_weights(tmp_path: Path) -> None:
    changes = tiny.TINY | {"steps": 12_000, "evaluate_every": 12_000, "checkpoint_every": 400}
    settings = [f"{name}={value}" for name, value in changes.items()]
    job = sweep.jobs(["point-u"], ["sac"], [0], ["--set", *settings])[0]
    run = RunFolder(tmp_path / "killed" / job.name)
    with started(0) as cluster:
        node = cluster.add_node(num_cpus=1)
        states: list[sweep.Status] = []
        address = cluster.address

        def train(out: Path) -> None:
            states.extend(sweep.run([job], out, lambda found: None, ray_address=address))

        killed = threading.Thread(target=train, args=(tmp_path / "killed",), daemon=True)
        killed.start()
        first = after_a_checkpoint(run)
        os.kill(parent(first), signal.SIGKILL)
        wait_for(lambda: not is_running(first))
        second = after_a_checkpoint(run)
        cluster.add_node(num_cpus=1)
        cluster.remove_node(node, allow_graceful=False)
        wait_for(lambda: not is_running(second))
        assert not complete.is_evaluated(run, 12_000)
        killed.join()
        train(tmp_path / "whole")
    assert [status.state for status in states] == ["finished", "finished"]
    whole = RunFolder(tmp_path / "whole" / job.name)
    for name in ("policy_weights", "policy_config"):
        assert getattr(run, name).read_bytes() == getattr(whole, name).read_bytes()
    rewards = [tables.read(folder.metrics_file)["critic/loss"] for folder in (run, whole)]
    np.testing.assert_array_equal(*rewards)


def after_a_checkpoint(run: RunFolder) -> int:
    """Wait until a process that trains a run has written a checkpoint; return the process."""
    before = set(steps_in(run.checkpoints))
    wait_for(lambda: set(steps_in(run.checkpoints)) - before)
    return int(json.loads(run.lock_file.read_text())["pid"])


def test_a_cluster_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="not reached"):
        sweep.run([], tmp_path, lambda found: None, ray_address="127.0.0.1:1")
