"""Judge whether rays or boxes lie closer together than by chance, from the number of rays or boxes around them."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import binomial_tail

LEAST_LOG_ODDS = np.log(1e3)
"""The least log odds that a group is not there by chance. The odds already allow for the number of tried places. At this
value, one log in a thousand shows a group by chance. A larger value finds fewer groups."""


def crowded(inside: Ints, around: Ints, share: float, tried: int) -> Floats:
    """Return the log odds that a region holds more boxes than it would by chance.

    Without a group, the boxes lie evenly, so the number inside is binomial. The surroundings give the density (scan
    statistic).

    inside: the number of boxes in the region, an array of any shape. around: the number of boxes in the region and its
    surroundings together. share: the size of the region, as a share of both. tried: the number of tried places. With more
    places, a crowd by chance is more likely.
    """
    least = np.maximum(inside, 1)
    tail = binomial_tail(least, np.maximum(around - inside, 0) + least, share)
    return np.where(inside > 0, -np.log(np.maximum(tail * tried, 1e-300)), 0.0)
