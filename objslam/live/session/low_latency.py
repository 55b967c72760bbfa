"""Settings of the Python process that shorten its pauses, and keep its memory small for months."""

import ctypes
import gc
import sys

_SWITCH_INTERVAL = 5e-4  # The time until Python switches threads, s. A larger value costs less, but messages wait longer.

_LARGE = 2**20
"""Blocks of memory from this size on, bytes, go back to the system when they are freed. glibc itself raises the limit, up to
32 MB, when it frees a larger block, and then keeps the memory of a calibration. A larger value keeps more, and saves
time."""
_M_MMAP_THRESHOLD = -3  # The name of this limit in glibc's malloc.h.
_SOON = 2
"""A full garbage collection runs early if Python would run it after this number of smaller ones. A larger number collects
more often. With a smaller one, more collections come while a frame is being mapped."""


def configure() -> None:
    """Switch threads sooner than Python's 5 ms. Exempt present objects from garbage collection, to save pauses of 0.15 s.

    Where the C library is glibc, fix the size of the blocks that go back to the system.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL)
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE)
    gc.collect()
    gc.freeze()


def collect_early() -> None:
    """Run a full garbage collection now if one is soon due. It takes 20 ms, and else comes while a frame is being mapped.

    Call it when there is time. Without `configure`, Python alone decides.
    """
    # Python counts its exempt objects one by one, which takes milliseconds. So this comes last.
    if gc.get_count()[2] > gc.get_threshold()[2] - _SOON and gc.get_freeze_count():
        gc.collect()
