"""Process items in threads before the consumer needs them."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_In = TypeVar("_In")
_Out = TypeVar("_Out")
_THREADS = 2  # The number of threads. A single thread decodes PNG images more slowly than a GPU runs a network on them.


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
