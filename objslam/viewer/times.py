"""The timelines of a recording: the drive's stamps, and the solver's iterations."""

from __future__ import annotations

from typing import Any

import numpy as np

from objslam.types import Floats, Ints

STAMP, ITERATION = "stamp", "iteration"
_UNIX_TIME = 1e8  # s; stamps beyond it are dates, those below count from a start of their own


def is_date(stamp: float) -> bool:
    """Whether a stamp, s, is Unix time."""
    return stamp > _UNIX_TIME


def stamp_column(stamps: Floats) -> Any:
    """The timeline `stamp` for stamps (N,), s: dates where they are Unix time, durations otherwise."""
    import rerun as rr

    if len(stamps) and is_date(float(stamps[0])):
        return rr.TimeColumn(STAMP, timestamp=stamps)
    return rr.TimeColumn(STAMP, duration=stamps)


def iteration_column(numbers: Ints) -> Any:
    """The timeline `iteration` for numbers (N,)."""
    import rerun as rr

    return rr.TimeColumn(ITERATION, sequence=numbers)


def moments(stamps: Floats, of: Ints) -> tuple[Floats, Ints, Ints]:
    """Distinct stamps (M,), how many things each has (M,), and their order (R,); of: (R,) index of each thing's stamp.

    Every stamp gets its row, also where it has nothing: what the moment before showed must go.
    """
    distinct, moment = np.unique(stamps, return_inverse=True)
    mine = moment[of]
    return distinct, np.bincount(mine, minlength=len(distinct)), np.argsort(mine, kind="stable")
