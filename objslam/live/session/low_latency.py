"""Settings of the Python process that shorten its pauses."""

import gc
import sys

_SWITCH_INTERVAL = 5e-4  # The time until Python switches threads, s. A larger value costs less, but messages wait longer.


def configure() -> None:
    """Switch threads sooner than Python's 5 ms. Exempt present objects from garbage collection, to save pauses of 0.15 s."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
