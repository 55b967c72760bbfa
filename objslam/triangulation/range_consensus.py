"""Find the rays of an object that agree in bearing and range, where the bearings alone lead away from the ranges.

Bearings from nearly one place meet in every point along themselves. So one more bearing, of a box with another thing's
label, crosses them somewhere, and nothing but the ranges contradicts this place.
"""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off
from objslam.core.statistics import OUTLIER_RAY

_GROSS = 0.3
"""A range contradicts a position if it is off by more than this share of its distance. The surface of a large thing is
nearer than its middle, and depths of things behind are longer, by less. A larger share finds fewer misread boxes."""
_MOST = 0.5
"""A position is contradicted if more than the share `_MOST` of its ranges are. With a larger share, fewer misread boxes are
found. The ranges of objects in front of a wall may all be those of the wall."""
_DROPPED = 0.02
"""The largest share of rays without which bearings and ranges must agree, and one ray in any case. A detector misreads few
labels. With a larger share, depths of a wall, measured while the robot stood, could outweigh bearings from other places."""
_STARTS = 8
"""The most ends of ranges from which an agreement is sought. Nearly all rays must agree, so nearly each end is a good start.
With a larger number, objects with many rays take longer."""


def contradicted(index: Ints, used: Bools, distance: Floats, ranges: Floats, sigma: Floats, count: int) -> Ints:
    """Return the objects (n,) whose used rays have ranges, and more than half of these are far from the position.

    index: (R,) the object of each ray, -1 for none. used: (R,) the rays that agree in bearing. distance: (R,) m, from each
    ray's origin to its object. ranges: (R,) m, NaN if unknown. sigma: (R,) m, their standard deviations.
    """
    ranged = used & (index >= 0) & np.isfinite(ranges)
    off = np.abs(distance[ranged] - ranges[ranged])
    far = off > np.maximum(OUTLIER_RAY * sigma[ranged], _GROSS * distance[ranged])
    number = np.bincount(index[ranged], minlength=count)
    return np.flatnonzero(np.bincount(index[ranged][far], minlength=count) > _MOST * number)


def agreeing_with_ranges(
    origins: Floats, directions: Floats, noise: Floats, ranges: Floats, sigma: Floats, position_sigma: float
) -> Bools | None:
    """Return the largest set of rays (R,) of one object that agree in bearing and range. None if it lacks too many rays.

    None as well if no ray disagrees, because then the bearings do not lead away from the ranges.

    origins, directions: (R, 3) m, and unit vectors. noise: (R,) rad, the standard deviations of the bearings. ranges, sigma:
    (R,) m, as in `contradicted`. position_sigma: m, the standard deviation of the origins along each axis.
    """
    ranged = np.flatnonzero(np.isfinite(ranges))
    starts = ranged[:: -(-len(ranged) // _STARTS)]
    ends = origins[starts] + ranges[starts, None] * directions[starts]
    away = np.linalg.norm(ends[:, None] - origins, axis=2)
    # The end of a range has the noise of its own bearing and range, which another ray sees from its place.
    blur = np.hypot(np.hypot(noise[starts] * ranges[starts], sigma[starts]), np.sqrt(2) * position_sigma)[:, None]
    miss = np.stack([angles_off(origins, directions, np.broadcast_to(end, origins.shape)) for end in ends])
    bearing = miss <= OUTLIER_RAY * np.hypot(noise, blur / np.maximum(away, 1e-9))
    spread = np.hypot(sigma, blur)
    length = ~np.isfinite(ranges) | (np.abs(away - ranges) <= OUTLIER_RAY * spread)
    both = bearing & length
    best = both[both.sum(axis=1).argmax()]
    lacking = int((~best).sum())
    return best if 0 < lacking <= max(1, _DROPPED * len(best)) else None
