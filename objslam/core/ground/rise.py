"""The rise of ground that keeps its tilt for some time."""

import numpy as np

from objslam.core.arrays import Floats

_STEP = 1.0
"""The time (s) over which the speed of a robot is measured. In a shorter time, the noise of poses looks like motion. A
longer time cuts curves short."""


def rise_of(stamps: Floats, poses: Floats, tilts: Floats, times: Floats) -> float:
    """Return the standard deviation (m) of the height of ground below a path.

    Ground that tilts by an angle rises by this angle times the way that the robot drives. The whole path cannot rise over
    more than its own size. No ray of an object that was seen in one place shows this height, because it lifts the object and
    the robot alike.

    stamps: (K,) s, and poses: (K, 4, 4), of the path. tilts: (n,) rad, the standard deviations of independent parts of the
    tilt, and times: (n,) s, how long each of them lasts.
    """
    place = poses[:, :2, 3]
    first = np.unique(np.floor(stamps / _STEP), return_index=True)[1]
    way = np.linalg.norm(np.diff(place[first], axis=0), axis=1).sum()
    speed = float(way / max(np.ptp(stamps[first]), _STEP))
    reach = float(np.sqrt(place.var(axis=0).sum()))
    return float(np.linalg.norm(tilts * np.minimum(speed * times, reach)))
