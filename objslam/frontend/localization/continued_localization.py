"""Continue a localisation by the odometry, where the localisation has no poses.

Many localisations begin later than the recording, end earlier, or pause. The odometry tells how the robot moved meanwhile,
so a solve of the poses can use the boxes of these times too. The continued poses are where such a solve starts. They are no
measurements.
"""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import interpolate, inverse
from objslam.core.types import Log, Trajectory
from objslam.frontend.odometry_drift import gathered_drift

_DRIFT = 0.15
"""The largest standard deviation (rad) of the heading, by the settings of the odometry, that a continuation may gather. Rays
of poses that drifted more are associated with wrong things. In MRCLAM drives that keep a part of their localisation, 0.2 rad
gave 16 false objects in one drive, and 0.1 rad left out boxes that 0.15 rad uses. A larger value uses more boxes."""
_MOST = 0.5
"""The largest share of the boxes that may lie on continued poses. If the odometry gives most poses, nothing shows the noise
of the localisation, and the ellipsoids become too small. A larger share continues shorter localisations."""


def continued_by_odometry(log: Log, settings: Settings) -> Log:
    """Return the log with a localisation that also has the poses of the odometry outside of its time and in its gaps.

    The continued poses join the localised poses at both ends of a gap. A gap of the odometry ends the continuation, because
    somebody may have moved the robot in it. It also ends where the odometry has drifted too far. The log is returned
    unchanged if there is nothing to continue, and if most boxes would lie on continued poses.
    """
    localization, odometry = log.localization, log.odometry
    if localization is None or odometry is None or not len(localization):
        return log
    max_gap = settings.poses.max_gap
    at, covered = interpolate(odometry.stamps, odometry.poses, localization.stamps, max_gap)
    if not covered.any():
        return log
    known = localization.stamps[covered]
    map_T_odom = localization.poses[covered] @ inverse(at[covered])
    sure, times = _near_localization(odometry, known, settings)
    free = sure & ~_between(localization.stamps, odometry.stamps, max_gap)
    if not free.any():
        return log
    stamps = odometry.stamps[free]
    offset, _ = interpolate(known, map_T_odom, times[free], np.inf)
    every = np.concatenate([localization.stamps, stamps])
    poses = np.concatenate([localization.poses, offset @ odometry.poses[free]])
    order = np.argsort(every)
    continued = replace(log, localization=Trajectory(every[order], poses[order]))
    return continued if share_on_continuation(log, continued, settings) <= _MOST else log


def share_on_continuation(log: Log, continued: Log, settings: Settings) -> float:
    """Return the share of the boxes that have a pose in `continued`, from `continued_by_odometry`, but not in the log."""
    before, after, max_gap = log.localization, continued.localization, settings.poses.max_gap
    stamps = [c.detections.frame_stamps[c.detections.frame] for c in log.cameras if c.detections is not None]
    boxes = np.concatenate([np.zeros(0), *stamps])
    if before is None or after is None or after is before or not len(boxes):
        return 0.0
    on_path = _between(after.stamps, boxes, max_gap)
    more = on_path & ~_between(before.stamps, boxes, max_gap)
    return float(more.sum() / max(on_path.sum(), 1))


def _between(poses: Floats, stamps: Floats, max_gap: float) -> Bools:
    """Return which stamps (Q,) are at one of the stamps of poses (N,), or between two that are at most max_gap apart (s)."""
    if len(poses) == 0:
        return np.zeros(len(stamps), dtype=bool)
    after = np.searchsorted(poses, stamps)
    before, next_ = poses[np.maximum(after - 1, 0)], poses[np.minimum(after, len(poses) - 1)]
    return (next_ == stamps) | ((before <= stamps) & (stamps <= next_) & (next_ - before <= max_gap))


def _near_localization(odometry: Trajectory, known: Floats, settings: Settings) -> tuple[Bools, Floats]:
    """Return which poses of an odometry (N,) drifted little since, or until, the nearest localised stamp (L,), s, without a
    gap of the odometry in between. Also return the times (N,), s, at which the offset of the odometry from the map holds for
    them. It is their own time between two localised stamps, unless one of the two lies beyond a gap or does not exist.
    """
    stamps = odometry.stamps
    turned = gathered_drift(odometry, np.concatenate([stamps, known]), settings.odometry)[:, 2, 2]
    drift, at_known = turned[: len(stamps)], turned[len(stamps) :]
    stretch = np.concatenate([[0], np.cumsum(np.diff(stamps) > settings.poses.max_gap)])
    of_known = stretch[np.clip(np.searchsorted(stamps, known), 0, len(stamps) - 1)]
    after = np.searchsorted(known, stamps)
    sure, joined, at = [], [], []
    for end in (after - 1, after):
        at.append(np.clip(end, 0, len(known) - 1))
        joined.append((end == at[-1]) & (stretch == of_known[at[-1]]))
        sure.append(joined[-1] & (np.abs(drift - at_known[at[-1]]) < _DRIFT**2))
    own = np.where(joined[0], known[at[0]], known[at[1]])
    return sure[0] | sure[1], np.where(joined[0] & joined[1], stamps, own)
