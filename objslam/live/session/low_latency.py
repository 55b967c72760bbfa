"""What keeps a process that works live from pausing where it need not."""

from __future__ import annotations

import gc
import sys

_SWITCH_INTERVAL = 5e-4
"""s until a thread gives way to another; by Python's own 5 ms, a message waits several times for the thread that makes the
map. Larger loses less time in switching."""


def configure() -> None:
    """Threads give way sooner, and what is there by now is not searched for garbage again: 0.15 s with all libraries."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
