"""Find the rays of an object that agree in bearing and range, if the bearings alone give a place far from the ranges.

Bearings from nearly one place agree with every point along them. A box of another thing with the same label may add a wrong
bearing. The wrong bearing crosses the others somewhere, and only the ranges contradict the crossing.
"""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off
from objslam.core.statistics import OUTLIER_RAY

_GROSS = 0.3
"""The error of a range, as a share of the distance, above which the range contradicts a position. Smaller errors are usual:
the surface of a large thing is nearer than its middle, and a range may end on a thing behind. With a larger share, fewer
boxes with wrong labels are found."""
_MOST = 0.5
"""A position is contradicted if more than this share of ranges contradict it. The ranges of an object in front of a wall may
all end on the wall. With a larger share, fewer boxes with wrong labels are found."""
_DROPPED = 0.02
"""The largest share of an object's rays that may be dropped so that the others agree. One ray may always be dropped. A
detector misreads few labels. With a larger share, ranges to a wall, measured while the robot stood, could outweigh bearings
from other places."""
_STARTS = 8
"""The most ends of ranges that are tried as positions. Nearly all rays must agree, so nearly each end is a good
start. With a larger number, objects with many rays take longer."""


def contradicted(index: Ints, used: Bools, distance: Floats, ranges: Floats, sigma: Floats, count: int) -> Ints:
    """Return the indices (n,) of the objects whose position contradicts more than half of the ranges of their used rays.

    index: (R,) the object of each ray, -1 for none. used: (R,) the rays that agree in bearing. distance: (R,) m, from each
    ray's origin to its object. ranges: (R,) m, NaN if unknown. sigma: (R,) m, the standard deviations of the ranges. count:
    the number of objects.
    """
    ranged = used & (index >= 0) & np.isfinite(ranges)
    off = np.abs(distance[ranged] - ranges[ranged])
    far = off > np.maximum(OUTLIER_RAY * sigma[ranged], _GROSS * distance[ranged])
    number = np.bincount(index[ranged], minlength=count)
    return np.flatnonzero(np.bincount(index[ranged][far], minlength=count) > _MOST * number)


def agreeing_with_ranges(
    origins: Floats, directions: Floats, noise: Floats, ranges: Floats, sigma: Floats, position_sigma: float
) -> Bools | None:
    """Return a mask (R,) of the most rays of one object that agree in bearing and range.

    Return None if too many rays disagree (`_DROPPED`). Also return None if no ray disagrees, because then the bearings give
    a place near the ranges.

    origins, directions: (R, 3) m, and unit vectors. noise: (R,) rad, the standard deviations of the bearings. ranges, sigma:
    (R,) m, as in `contradicted`. position_sigma: m, the standard deviation of the origins along each axis.
    """
    ranged = np.flatnonzero(np.isfinite(ranges))
    starts = ranged[:: -(-len(ranged) // _STARTS)]
    ends = origins[starts] + ranges[starts, None] * directions[starts]
    away = np.linalg.norm(ends[:, None] - origins, axis=2)
    # The end of a range has the noise of its own bearing and range. Another ray sees this noise from its own origin.
    blur = np.hypot(np.hypot(noise[starts] * ranges[starts], sigma[starts]), np.sqrt(2) * position_sigma)[:, None]
    miss = np.stack([angles_off(origins, directions, np.broadcast_to(end, origins.shape)) for end in ends])
    bearing = miss <= OUTLIER_RAY * np.hypot(noise, blur / np.maximum(away, 1e-9))
    spread = np.hypot(sigma, blur)
    length = ~np.isfinite(ranges) | (np.abs(away - ranges) <= OUTLIER_RAY * spread)
    both = bearing & length
    best = both[both.sum(axis=1).argmax()]
    lacking = int((~best).sum())
    return best if 0 < lacking <= max(1, _DROPPED * len(best)) else None
