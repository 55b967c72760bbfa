"""Work on items ahead of the one who takes them, in threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_In = TypeVar("_In")


_Out = TypeVar("_Out")


_THREADS = 2  # a PNG takes longer to decode than a network on a GPU takes


def ahead(work: Callable[[_In], _Out], items: Iterable[_In], depth: int) -> Iterator[_Out]:
    """work(item) for each item, in order, done in threads that are at most `depth` items ahead."""
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
