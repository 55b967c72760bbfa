"""The engines of a fleet: each runs a function on many arguments, and yields each answer as it comes.

An engine is called with the name of a function, "module:function", and its arguments. The number of arguments and answers
that it holds is bounded, so that a fleet of any size needs the memory of a small one.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from objslam.errors import ObjslamError, one_line
from objslam.fleet.engines.worker import LimitError, Limits, LostError, Worker
from objslam.fleet.stores.store import StoreError


@dataclass(frozen=True, slots=True)
class Answer:
    """The outcome of one task. value: what the function returned, None after a failure. message: the words of a failure.

    kind: the kind of a failure, which is `memory`, `time`, `lost`, `store` or `error`. It is empty after a success.
    """

    argument: Any
    value: Any
    kind: str = ""
    message: str = ""
    running: int = 0


Engine = Callable[[str, Iterable[Any]], Iterator[Answer]]
"""A function that runs the work, named as "module:function", on each argument, and yields the answers in any order."""

_QUEUED = 2
"""The most tasks of each process that are submitted and not answered yet. A larger number keeps processes busy while
arguments come slowly."""


def attempt(worker: Worker, work: str, argument: Any, limits: Limits) -> Answer:
    """Run one task in a worker, and return its answer or its failure. The process that owns the worker calls this."""
    try:
        return Answer(argument, worker.call(work, argument, limits))
    except LimitError as error:
        return Answer(argument, None, error.kind, str(error))
    except LostError as error:
        return Answer(argument, None, "lost", str(error))
    except StoreError as error:
        return Answer(argument, None, "store", str(error))
    except ObjslamError as error:
        return Answer(argument, None, "error", str(error))
    except MemoryError as error:
        return Answer(argument, None, "memory", f"out of memory: {one_line(error)}")


class _Pool:
    """Threads, each of which waits for the answers of a process of its own. A thread computes nothing.

    The threads stay with their processes. A process dies with the thread that started it.
    """

    def __init__(self, jobs: int, limits: Limits) -> None:
        self._threads = ThreadPoolExecutor(jobs, "objslam fleet")
        self._own, self._workers, self._limits = threading.local(), list[Worker](), limits

    def submit(self, work: str, argument: Any) -> Future[Answer]:
        return self._threads.submit(self._task, work, argument)

    def _task(self, work: str, argument: Any) -> Answer:
        if not hasattr(self._own, "worker"):
            self._own.worker = Worker()
            self._workers.append(self._own.worker)
        return attempt(self._own.worker, work, argument, self._limits)

    def end(self) -> None:
        """End the processes, whatever they do, and then the threads, which wait for them."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.close()
        self._threads.shutdown()


def local_engine(jobs: int, limits: Limits) -> Engine:
    """Return the engine of this machine, with `jobs` processes. Each does one task at a time.

    The processes also do the tasks of the next call, so that each imports the libraries once. They end with the engine, and
    with a call whose answers are not all taken.
    """
    pools: list[_Pool] = []

    def run(work: str, arguments: Iterable[Any]) -> Iterator[Answer]:
        pool = pools.pop() if pools else _Pool(jobs, limits)
        try:
            yield from _in_flight(lambda argument: pool.submit(work, argument), arguments, jobs)
        except BaseException:
            pool.end()
            raise
        pools.append(pool)

    weakref.finalize(run, _end, pools)
    return run


def _end(pools: list[_Pool]) -> None:
    for pool in pools:
        pool.end()


def _in_flight(submit: Callable[[Any], Future[Answer]], arguments: Iterable[Any], jobs: int) -> Iterator[Answer]:
    """Yield the answer of each task. jobs: the number of processes."""
    left = iter(arguments)
    running = {submit(argument) for argument in islice(left, jobs * _QUEUED)}
    while running:
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for one in done:
            running |= {submit(argument) for argument in islice(left, 1)}
            yield replace(one.result(), running=min(len(running), jobs))


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


def memory_of_machine() -> int:
    """Return the bytes of RAM of this machine, or of its container if that may use less."""
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(whole, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # There is no control group, or its limit is "max".
        return whole
