"""Start threads, and process items in threads before the consumer needs them."""

import mmap
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_In = TypeVar("_In")
_Out = TypeVar("_Out")
_THREADS = 2  # The number of threads of `ahead`. One thread decodes PNG images more slowly than a GPU runs a detector.

_ROOM = 16 << 20
"""The memory that must be free for a thread to start, bytes. The stack of a thread takes 8 MiB, and its first steps take
less than 32 kB. With a larger number, a thread needs more free memory to start."""


def start_thread(thread: threading.Thread) -> None:
    """Start a thread. Raises OSError with the code ENOMEM if too little memory is free.

    If a new thread has a stack but no memory for its first steps, `threading.Thread.start` of Python 3.11 waits forever.
    """
    mmap.mmap(-1, _ROOM).close()
    thread.start()


def ahead(work: Callable[[_In], _Out], items: Iterable[_In], depth: int) -> Iterator[_Out]:
    """Yield work(item) for each item, in order. Threads compute up to `depth` results before the caller needs them."""
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
