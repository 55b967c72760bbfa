"""The engine of this machine, and the types that all engines share.

An engine runs a function on many arguments, and yields each answer as soon as it is known. An engine is called with the name
of the function, "module:function", and its arguments. It holds only a limited number of arguments and answers. So its memory
does not grow with the size of the fleet.
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
    """The outcome of one task. value: what the function returned, None after a failure. message: the text of the error after
    a failure.

    kind: the kind of a failure, which is `memory`, `time`, `lost`, `store` or `error`. It is empty after a success. running:
    the number of tasks that run when an engine yields this answer.
    """

    argument: Any
    value: Any
    kind: str = ""
    message: str = ""
    running: int = 0


Engine = Callable[[str, Iterable[Any]], Iterator[Answer]]
"""The type of an engine. It is a function that gets the name of a function, "module:function", and its arguments. It runs
this function on each argument, and yields the answers in any order."""

_QUEUED = 2
"""The largest number of tasks of each process that are submitted and not answered yet. With a larger number, processes stay
busy even if arguments come slowly."""


def attempt(worker: Worker, work: str, argument: Any, limits: Limits) -> Answer:
    """Run one task in a worker, and return its answer. A failure of the task is also an answer. Only the process that owns
    the worker may call this function."""
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
    """A pool of threads. Each thread has a process of its own, and only waits for the answers of this process.

    The threads live as long as their processes, because a process dies with the thread that started it.
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
        """End the processes, even if a task is running. Then end the threads, which wait for their processes."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.close()
        self._threads.shutdown()


def local_engine(jobs: int, limits: Limits) -> Engine:
    """Return the engine of this machine, with `jobs` processes. Each process does one task at a time.

    The processes stay for the next call, so that each process imports the libraries once. They end when the engine is
    deleted. They also end if a call fails, or if its caller does not take all answers.
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
    """Yield the answer of each task. submit: starts the task of an argument. jobs: the number of processes."""
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
    """Return the RAM, bytes, of this machine, or of its container if the container may use less."""
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(whole, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # There is no control group, or its limit is "max".
        return whole
