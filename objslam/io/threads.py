"""Start threads, and process items in threads before the consumer needs them."""

import mmap
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_In = TypeVar("_In")
_Out = TypeVar("_Out")
_THREADS = 2  # The number of threads. A single thread decodes PNG images more slowly than a GPU runs a network on them.

_ROOM = 16 << 20
"""The memory that must be free for a thread to start, bytes. Its stack takes 8 MiB, and its first steps less than 32 kB. A
larger number refuses to start a thread earlier."""


def start_thread(thread: threading.Thread) -> None:
    """Start a thread. Raises OSError ENOMEM if too little memory is free.

    If a new thread has a stack but no memory for its first steps, `threading.Thread.start` of Python 3.11 waits forever.
    """
    mmap.mmap(-1, _ROOM).close()
    thread.start()


def ahead(work: Callable[[_In], _Out], items: Iterable[_In], depth: int) -> Iterator[_Out]:
    """Yield work(item) for each item in order. Threads compute up to `depth` results before the caller asks for them."""
    waiting: deque[Future[_Out]] = deque()
    pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="objslam-images")
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
