"""Waiting for what another thread or process does. How long that takes is no part of any test."""

import time
from collections.abc import Callable
from typing import TypeVar

LIMIT = 600.0
"""s; reached only where what is waited for never comes, however busy the machine is."""

_T = TypeVar("_T")


def wait_for(condition: Callable[[], _T], step: float = 0.01) -> _T:
    """Ask every `step` seconds until the answer is true, and return it; AssertionError after `LIMIT`."""
    end = time.monotonic() + LIMIT
    while not (answer := condition()):
        assert time.monotonic() < end, f"waited in vain for {LIMIT:g} s"
        time.sleep(step)
    return answer


def pause(seconds: float) -> None:
    """Wait for so long at least, where something must have aged: a longer pause changes nothing."""
    time.sleep(seconds)
