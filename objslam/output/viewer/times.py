"""The timelines of a recording: the drive's stamps, and the solver's iterations."""

from __future__ import annotations

from typing import Any

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.output.plot.style import is_date

STAMP = "stamp"  # The timeline of the drive.
ITERATION = "iteration"  # The timeline of the solver.


def stamp_column(stamps: Floats) -> Any:
    """The timeline `stamp` for stamps (N,), s: dates where they are Unix time, else durations."""
    import rerun as rr

    if len(stamps) and is_date(float(stamps[0])):
        return rr.TimeColumn(STAMP, timestamp=stamps)
    return rr.TimeColumn(STAMP, duration=stamps)


def iteration_column(numbers: Ints) -> Any:
    """The timeline `iteration` for numbers (N,)."""
    import rerun as rr

    return rr.TimeColumn(ITERATION, sequence=numbers)


def moments(stamps: Floats, of: Ints) -> tuple[Floats, Ints, Ints]:
    """Things sorted into the moments at which they are shown.

    Every stamp gets a row, even without a thing: what the moment before showed must go.

    Args:
        stamps: (K,) s, ascending.
        of: (R,) the index of each thing's stamp.
    Returns:
        The distinct stamps (M,), the number of things at each (M,), and the order (R,) of the things by stamp.
    """
    distinct, moment = np.unique(stamps, return_inverse=True)
    mine = moment[of]
    return distinct, np.bincount(mine, minlength=len(distinct)), np.argsort(mine, kind="stable")
