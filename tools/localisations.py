"""Localise a simulated robot: poses that err for seconds, as a particle filter, a scan matcher or satellites give them."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse, lift_se2
from objslam.core.trajectory import Trajectory

KINDS = ("filter", "poses", "slam", "satellites")
EVERY = 0.1  # s, between two poses of a scan matcher, and the steps at which the errors of a particle filter are drawn
MOVED, TURNED = 0.2, 0.2  # m and rad, after which a particle filter corrects its pose, as AMCL does by default


def localised(rng: np.random.Generator, kind: str, stamps: Floats, path: Floats, odometry: Trajectory) -> Trajectory:
    """Return a localisation of a robot whose path is x, y, yaw (n, 3), m and rad, at stamps (n,), s.

    filter: AMCL by tf. The odometry moves the pose between two corrections, and each correction is a step. poses: the poses
    of AMCL at its corrections alone. slam: a scan matcher, ten times in a second. satellites: positions that err by up to
    more than a metre, five times in a second or once. The errors are a first-order Gauss-Markov process and a part that is
    new in each pose, with sizes and a time that are drawn once for a robot.
    """
    apart = EVERY
    if kind == "slam":
        place, yaw, seconds, new = rng.uniform(0.005, 0.03), np.radians(rng.uniform(0.1, 0.5)), rng.uniform(10, 40), 0.3
    elif kind == "satellites":
        place, yaw, seconds = rng.uniform(0.2, 1.2), np.radians(rng.uniform(1, 4)), rng.uniform(10, 60)
        new, apart = float(rng.choice([0.1, 0.3, 0.5])), float(rng.choice([0.2, 1.0]))
    else:
        place, yaw, seconds, new = rng.uniform(0.02, 0.08), np.radians(rng.uniform(0.3, 1.5)), rng.uniform(3, 20), 0.4
    each = max(round(apart / float(np.median(np.diff(stamps)))), 1)
    stamps, path = stamps[::each], path[::each]
    kept, lasting = np.exp(-apart / seconds), rng.normal(size=(len(stamps), 3))
    for i in range(1, len(lasting)):
        lasting[i] = kept * lasting[i - 1] + np.sqrt(1 - kept**2) * lasting[i]
    errors = np.sqrt(1 - new**2) * lasting + new * rng.normal(size=lasting.shape)
    said = lift_se2(path + errors * [place, place, yaw])
    if kind in ("slam", "satellites"):
        return Trajectory(stamps, said)
    corrected = [0]
    for i in range(1, len(path)):
        x, y, turn = path[i] - path[corrected[-1]]
        if np.hypot(x, y) > MOVED or abs(turn) > TURNED:
            corrected.append(i)
    if kind == "poses":
        return Trajectory(stamps[corrected], said[corrected])
    # As tf does, the odometry is interpolated to the time of the scan. The last scan may come after the odometry.
    moments = np.minimum(stamps[corrected], odometry.stamps[-1])
    map_T_odom = said[corrected] @ inverse(interpolate(odometry.stamps, odometry.poses, moments, np.inf)[0])
    last = np.maximum(np.searchsorted(stamps[corrected], odometry.stamps, side="right") - 1, 0)
    return Trajectory(odometry.stamps, map_T_odom[last] @ odometry.poses)
