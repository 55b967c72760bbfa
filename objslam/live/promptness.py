"""What keeps a process that works live from pausing where it need not."""

from __future__ import annotations

import gc
import sys

_HAND_OVER = 5e-4  # s; a message does not wait Python's 5 ms, several times over, for the thread that makes the map


def be_prompt() -> None:
    """Threads give way sooner, and what is there by now is not searched for garbage again: 0.15 s with all libraries."""
    sys.setswitchinterval(_HAND_OVER)
    gc.collect()
    gc.freeze()
