"""Jobs on a Ray cluster whose machines share the jobs' folder.

Each job is one Ray task of one processor. A task whose machine is lost is run again on another one,
where it resumes from the newest whole checkpoint.
"""

import socket
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from midway.cluster.jobs import POLL_SECONDS, Execute, Job, State, execute, finished
from midway.errors import ConfigurationError, needing

RETRIES = 20
REACH_SECONDS = 10.0


def start(
    wanted: Sequence[Job], folder: Path, states: dict[Job, State], address: str
) -> list[threading.Thread]:
    """Submit every job that is not finished and return the thread that collects the results.

    Raises:
        ConfigurationError: Ray is not installed, or the cluster is not reached.
    """
    ray, task = _connected(address)
    running = {}
    for job in wanted:
        if finished(job, folder):
            states[job] = "finished"
        else:
            running[task.remote(job, str(folder.absolute()))] = job
            states[job] = "running"

    def collect() -> None:
        left: list[object] = list(running)
        while left:
            done, left = ray.wait(left)
            for reference in done:
                states[running[reference]] = _result(ray, reference)

    return [threading.Thread(target=collect, daemon=True)]


def processors(address: str, ending: threading.Event) -> Sequence[Execute]:
    """Return what runs a job, once for each processor of the cluster.

    A job is told to stop by a file in its folder, which all machines see.

    Args:
        address: Address of the cluster.
        ending: Once it is set, every job is told to stop.

    Raises:
        ConfigurationError: Ray is not installed, or the cluster is not reached or has no processor.
    """
    ray, task = _connected(address)

    def run(job: Job, folder: Path, stop: Callable[[], bool]) -> State:
        wish = _wish(job, folder)
        wish.unlink(missing_ok=True)
        reference = task.remote(job, str(folder.absolute()))
        while not ray.wait([reference], timeout=POLL_SECONDS)[0]:
            if not wish.exists() and (ending.is_set() or stop()):
                wish.touch()
        wish.unlink(missing_ok=True)
        state = _result(ray, reference)
        return "stopped" if ending.is_set() and state == "failed" else state

    count = int(ray.cluster_resources().get("CPU", 0))
    if count == 0:
        raise ConfigurationError(f"Ray cluster {address} has no processor")
    return count * [run]


def _connected(address: str) -> tuple[Any, Any]:
    """Return Ray, connected to a cluster, and the task that runs a job there.

    Raises:
        ConfigurationError: Ray is not installed, or the cluster is not reached.
    """
    with needing("cluster", "--ray"):
        import ray
    _check_reached(address)
    try:
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    except (ConnectionError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigurationError(f"Ray cluster {address} is not reached: {reason}") from error
    return ray, ray.remote(num_cpus=1, max_retries=RETRIES)(_run_to_its_end)


def _check_reached(address: str) -> None:
    """Fail at once where nobody listens; Ray itself would go on trying for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and port.isdecimal()):
        return
    try:
        socket.create_connection((host, int(port)), timeout=REACH_SECONDS).close()
    except OSError as error:
        raise ConfigurationError(f"Ray cluster {address} is not reached: {error}") from error


def _run_to_its_end(job: Job, folder: str) -> bool:
    wish = _wish(job, Path(folder))
    return execute(job, Path(folder), stop=wish.exists) == "finished"


def _wish(job: Job, folder: Path) -> Path:
    """Return the file that is there while a job shall stop."""
    return folder / f"{job.name}.stop"


def _result(ray: Any, reference: object) -> State:
    try:
        return "finished" if ray.get(reference) else "failed"
    except ray.exceptions.RayError:
        return "failed"
