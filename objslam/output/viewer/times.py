"""The timelines of a recording: the stamps of the drive and the iterations of the solver."""

from typing import Any

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.validity import is_date

STAMP, ITERATION = "stamp", "iteration"  # The names of the timelines of the drive and of the solver.


def stamp_column(stamps: Floats) -> Any:
    """Return a column of the timeline `stamp` from stamps (N,), s. Unix times become dates, other stamps durations."""
    import rerun as rr

    if len(stamps) and is_date(float(stamps[0])):
        return rr.TimeColumn(STAMP, timestamp=stamps)
    return rr.TimeColumn(STAMP, duration=stamps)


def iteration_column(numbers: Ints) -> Any:
    """Make a column of the timeline `iteration` from the numbers (N,) of iterations."""
    import rerun as rr

    return rr.TimeColumn(ITERATION, sequence=numbers)


def moments(stamps: Floats, of: Ints) -> tuple[Floats, Ints, Ints]:
    """Group items by their stamp. A stamp without items is kept, so that the viewer shows no older items at this stamp.

    Args:
        stamps: (K,) s, ascending.
        of: (R,) for each item, the index of its stamp in `stamps`.
    Returns:
        The distinct stamps (M,), the number of items at each stamp (M,), and the order (R,) of the items by stamp.
    """
    distinct, moment = np.unique(stamps, return_inverse=True)
    mine = moment[of]
    return distinct, np.bincount(mine, minlength=len(distinct)), np.argsort(mine, kind="stable")
