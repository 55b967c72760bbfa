"""The engine of a Ray cluster. Each task is a task of Ray Core. Its worker is a process of the node that runs the task.

Ray places the tasks, and runs them again if a node is lost. Tasks write their results into the store, and never send them
through Ray.
"""

from __future__ import annotations

import atexit
import logging
import os
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from objslam.errors import ConfigError, ObjslamError, first_line
from objslam.fleet.engines.local_engine import Answer, Engine, attempt
from objslam.fleet.engines.worker import Limits, Worker

_QUEUED = 2
"""The number of submitted tasks for each CPU of the cluster, if the caller does not set their number. With a larger number,
more tasks are ready for a free CPU."""
_PATIENT = 10.0
"""The longest time (s) in which the address of a cluster must accept a connection. With a larger value, the error for a
wrong address comes later."""
_GB = 1e9
_LEASE = "RAY_worker_lease_timeout_milliseconds", "60000"
"""The name and the value of an environment variable of Ray: the time (ms) for which a driver keeps a process. After a task
that takes longer, the driver gives the process back and requests another one. With tasks of 1 s on two nodes, this takes 0.1
s per log at Ray's default of 500 ms, and 7 ms at this value. With a larger value, other drivers of a full cluster wait
longer."""

_worker = Worker()
"""The worker of this process of Ray. It stays between tasks, so that it imports the libraries once."""
atexit.register(_worker.close)


@dataclass(frozen=True)
class Cluster:
    """A cluster that this process joined. cpus, gpus: the numbers of CPUs and GPUs of all nodes. dashboard: the address of
    the cluster's web page, empty if it has none."""

    cpus: float
    gpus: float
    dashboard: str


def join_cluster(address: str) -> Cluster:
    """Join the Ray cluster at an address. The address `auto` means the cluster that runs on this machine. This function
    never starts a cluster.

    ObjslamError if Ray is not installed, or if no cluster answers.
    """
    os.environ.setdefault(*_LEASE)  # Ray reads this variable at its import.
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ObjslamError("Ray is not installed", hint="pip install objslam[fleet]") from error
    hint = "start one with ray start, or leave --ray out to use the processes of this machine"
    host, mark, port = address.removeprefix("ray://").rpartition(":")
    try:
        if mark and port.isdigit():  # Without a listener, Ray itself waits for minutes.
            socket.create_connection((host.strip("[]"), int(port)), _PATIENT).close()
        context = ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, OverflowError, ValueError, RuntimeError) as error:
        raise ObjslamError(f"no Ray cluster answers: {first_line(error)}", where=address, hint=hint) from error
    found = ray.cluster_resources()
    return Cluster(found.get("CPU", 0.0), found.get("GPU", 0.0), str(getattr(context, "dashboard_url", "") or ""))


def leave_cluster() -> None:
    """Leave the cluster that `join_cluster` joined. The cluster keeps running."""
    import ray

    ray.shutdown()


def ray_engine(limits: Limits, *, most: int, memory: int, gpus: float) -> Engine:
    """Return the engine of the cluster that was joined. Each task takes one CPU.

    most: the largest number of submitted tasks, 0 for twice the number of CPUs of the cluster. memory: the memory, bytes,
    that each task reserves on its node, 0 for none. gpus: the share of a GPU that each task takes. ConfigError if no node
    has enough for one task.
    """
    import ray

    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    wanted = {"CPU": 1.0, "memory": float(memory), "GPU": gpus}
    if not any(all(node.get(name, 0.0) >= amount for name, amount in wanted.items()) for node in nodes):
        asked = f"1 CPU, {memory / _GB:.1f} GB of memory and {gpus:g} GPU"
        raise ConfigError(f"no node of the cluster has {asked} for a task", hint="change --memory, or add nodes")
    options: dict[str, Any] = {"num_cpus": 1, "num_gpus": gpus, "max_retries": limits.retries}
    if memory:
        options["memory"] = memory
    remote = ray.remote(**options)(_task)
    cpus = sum(node.get("CPU", 0.0) for node in nodes)

    def run(work: str, arguments: Iterable[Any]) -> Iterator[Answer]:
        left, running = iter(arguments), {}

        def submit(count: int) -> None:
            for argument in islice(left, count):
                running[remote.remote(work, argument, limits)] = argument

        submit(most or max(int(_QUEUED * cpus), 1))
        try:
            while running:
                done, _ = ray.wait(list(running), num_returns=1)
                argument = running.pop(done[0])
                submit(1)
                yield replace(_answer(done[0], argument), running=min(len(running), int(cpus)))
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    return run


def _answer(reference: Any, argument: Any) -> Answer:
    """Return the answer of a task of Ray. Its kind is `lost` if the cluster lost the task in every try."""
    import ray

    try:
        value, kind, message = ray.get(reference)
    except ray.exceptions.RayError as error:
        return Answer(argument, None, "lost", f"the cluster lost the task: {first_line(error)}")
    return Answer(argument, value, kind, message)


def _task(work: str, argument: Any, limits: Limits) -> tuple[Any, str, str]:
    """Do one task on a node, in the worker of this process of Ray. Return value, kind and message of its `Answer`."""
    answer = attempt(_worker, work, argument, limits)
    return answer.value, answer.kind, answer.message
