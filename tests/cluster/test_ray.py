"""A sweep on a local Ray cluster of several nodes, one of which is killed in the middle."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import midway
from midway.cluster import sweep
from midway.cluster.jobs import finished
from midway.errors import ConfigurationError

pytestmark = [
    pytest.mark.extra,
    pytest.mark.timeout(1800),
    # Ray leaves sockets and files of its own processes to the garbage collector.
    pytest.mark.filterwarnings("ignore"),
]

TINY = {
    "hidden": (8,),
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 16,
    "replay_capacity": 2_000,
    "evaluate_every": 1_000,
    "evaluation_episodes": 2,
    "log_every": 500,
    "checkpoint_every": 100,
    "steps": 2_000,
}


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head without processors and two nodes with one each."""
    import ray
    from ray.cluster_utils import Cluster

    started = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    yield started
    ray.shutdown()
    started.shutdown()


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait for what is sure to come; how long it may take is the time limit of the test."""
    while not condition():
        time.sleep(0.02)


def processes(folder: Path) -> list[int]:
    """Return the processes whose command line names the run folder; a zombie has none."""
    found = []
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = command.read_bytes().split(b"\0")
        except OSError:  # it has ended
            continue
        if b"midway.cli" in words and os.fsencode(folder) in words:
            found.append(int(command.parent.name))
    return found


def stop_at_first_checkpoint(folder: Path) -> int:
    """Hold the run in the middle, and return its process."""
    wait_for(lambda: any(path.name.isdecimal() for path in (folder / "checkpoints").glob("*")))
    (process,) = processes(folder)
    os.kill(process, signal.SIGSTOP)
    return process


def test_runs_of_a_killed_node_are_resumed_on_another(cluster: Any, tmp_path: Path) -> None:
    """Their results equal those of a run that nothing ever happened to."""
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    cluster.wait_for_nodes()
    options = ["--set", *[f"{name}={value}" for name, value in TINY.items()]]
    jobs = sweep.jobs(["point-u"], ["sac"], [0, 1], options)
    ended: list[sweep.Status] = []
    sweeping = threading.Thread(
        target=lambda: ended.extend(
            sweep.run(jobs, tmp_path, lambda found: None, ray_address=cluster.address)
        ),
        daemon=True,
    )
    sweeping.start()
    folders = [tmp_path / job.name for job in jobs]
    with ThreadPoolExecutor() as threads:
        stopped = set(threads.map(stop_at_first_checkpoint, folders))
    assert not any(finished(job, tmp_path) for job in jobs)
    cluster.remove_node(nodes[0], allow_graceful=False)
    wait_for(lambda: not all(processes(folder) for folder in folders))
    (survivor,) = (process for folder in folders for process in processes(folder))
    assert survivor in stopped
    os.kill(survivor, signal.SIGCONT)
    sweeping.join()
    assert [status.state for status in ended] == ["finished", "finished"]
    logs = [(tmp_path / f"{job.name}.log").read_text() for job in jobs]
    assert [log.count("finished") for log in logs] == [1, 1]
    for seed, folder in enumerate(folders):
        whole = midway.train(
            "point-u", agent="sac", seed=seed, out=tmp_path / f"whole{seed}", changes=TINY
        )
        weights = [path / "policy.safetensors" for path in (folder, whole.path)]
        assert weights[0].read_bytes() == weights[1].read_bytes()


def test_a_cluster_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="not reached"):
        sweep.run([], tmp_path, lambda found: None, ray_address="127.0.0.1:1")
