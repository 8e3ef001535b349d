"""Jobs of a sweep on a Ray cluster whose machines share the sweep's folder.

Each job is one Ray task of one processor. A task whose machine is lost is run again on another one,
where it resumes from the newest whole checkpoint.
"""

import socket
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from midway.cluster.jobs import Job, State, execute, finished
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
    with needing("cluster", "--ray"):
        import ray
    _check_reached(address)
    try:
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    except (ConnectionError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigurationError(f"Ray cluster {address} is not reached: {reason}") from error
    task = ray.remote(num_cpus=1, max_retries=RETRIES)(_run_to_its_end)
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
    return execute(job, Path(folder)) == "finished"


def _result(ray: Any, reference: object) -> State:
    try:
        return "finished" if ray.get(reference) else "failed"
    except ray.exceptions.RayError:
        return "failed"
