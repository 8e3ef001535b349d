"""A sweep on a local Ray cluster of several nodes, one of which is killed in the middle."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import midway
from midway.cluster import sweep
from midway.cluster.jobs import finished
from midway.types import ConfigurationError

pytestmark = [
    pytest.mark.slow,
    # Ray leaves sockets and files of its own processes to the garbage collector.
    pytest.mark.filterwarnings("ignore"),
]

TINY = {
    "hidden": (8,),
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 16,
    "replay_capacity": 2_000,
    "evaluate_every": 2_000,
    "evaluation_episodes": 2,
    "log_every": 500,
    "checkpoint_every": 200,
    "steps": 6_000,
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


def wait_for(condition: Callable[[], Any], seconds: float) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.05)


def test_runs_of_a_killed_node_are_resumed_on_another(cluster: Any, tmp_path: Path) -> None:
    """Their results equal those of a run that nothing ever happened to."""
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    cluster.wait_for_nodes()
    options = ["--set", *[f"{name}={value}" for name, value in TINY.items()]]
    jobs = sweep.jobs(["point-u"], ["sac"], [0, 1], options)
    ended: list[sweep.Status] = []
    thread = threading.Thread(
        target=lambda: ended.extend(
            sweep.run(jobs, tmp_path, lambda found: None, ray_address=cluster.address)
        )
    )
    thread.start()
    folders = [tmp_path / job.name for job in jobs]
    saved = [folder / "checkpoints" for folder in folders]
    wait_for(lambda: all(any(path.glob("[0-9]*")) for path in saved), 240)
    assert not any(finished(job, tmp_path) for job in jobs)
    cluster.remove_node(nodes[0], allow_graceful=False)
    thread.join(480)
    assert [status.state for status in ended] == ["finished", "finished"]
    resumed = [(tmp_path / f"{job.name}.log").read_text().count("finished") for job in jobs]
    assert sum(resumed) == 2
    for seed, folder in enumerate(folders):
        whole = midway.train(
            "point-u", agent="sac", seed=seed, out=tmp_path / f"whole{seed}", changes=TINY
        )
        weights = [path / "policy.safetensors" for path in (folder, whole.path)]
        assert weights[0].read_bytes() == weights[1].read_bytes()


def test_a_cluster_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="not reached"):
        sweep.run([], tmp_path, lambda found: None, ray_address="127.0.0.1:1")
