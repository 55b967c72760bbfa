"""Settings of the Python process that shorten its pauses, and keep its memory small for months."""

import ctypes
import gc
import sys

_SWITCH_INTERVAL = 5e-4  # The time until Python switches threads, s. A larger value costs less, but messages wait longer.

_LARGE = 2**20
"""The size, bytes, from which on a block of memory goes back to the system when it is freed. Without this setting, glibc
raises the size up to 32 MB when a larger block is freed, and then keeps the memory of a calibration. A larger value keeps
more memory, and saves time."""
_M_MMAP_THRESHOLD = -3  # The name of this limit in glibc's malloc.h.
_SOON = 2
"""A full garbage collection may run early if at most this number of smaller collections would come before it. A larger
number collects more often. With a smaller number, more full collections come while a frame is being mapped."""


def configure() -> None:
    """Make Python switch threads sooner. Exempt present objects from garbage collection, which saves pauses of 0.15 s.

    If the C library is glibc, fix the size of the blocks that go back to the system (`_LARGE`).
    """
    sys.setswitchinterval(_SWITCH_INTERVAL)
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE)
    gc.collect()
    gc.freeze()


def collect_early() -> None:
    """Run a full garbage collection now if one is soon due. A collection takes 20 ms, and could otherwise come while a frame
    is being mapped.

    Call this function when no message waits. Without `configure`, it does nothing, and Python alone decides.
    """
    # Python counts its exempt objects one by one, which takes milliseconds. So this comes last.
    if gc.get_count()[2] > gc.get_threshold()[2] - _SOON and gc.get_freeze_count():
        gc.collect()
