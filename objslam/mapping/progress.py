"""The function by which a driver reports its progress, and the times of its stages."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""The type of a function that reports progress. Its arguments are the stage's name, the number of steps done, and the total
number of steps (0 if unknown)."""


@contextmanager
def stage(name: str, seconds: dict[str, float], progress: Progress) -> Iterator[None]:
    """Report the begin of a stage, and put the stage's wall-clock time (s) into `seconds`."""
    progress(name, 0, 0)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 4)
