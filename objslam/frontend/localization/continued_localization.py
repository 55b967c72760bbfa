"""Continue a localisation by the odometry, where the localisation has no poses.

Many localisations begin later than the recording, end earlier, or pause. The odometry tells how the robot moved meanwhile,
so a solve of the poses can also use the boxes of such times. The continued poses are the start values of such a solve. They
are no measurements.
"""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.odometry_drift import gathered_drift

_DRIFT = 0.15
"""The largest standard deviation (rad) of the heading that a continuation may gather. The settings of the odometry give this
standard deviation. Rays of poses that drifted more are associated with wrong things. In MRCLAM drives that keep a part of
their localisation, 0.2 rad gave 16 false objects in one drive, and 0.1 rad left out boxes that 0.15 rad uses. A larger value
uses more boxes."""
_MOST = 0.5
"""The largest share of the boxes that may lie on continued poses, except poses between two measured ones. If the odometry
gives most poses, nothing shows the noise of the localisation, and the ellipsoids become too small. A larger share continues
shorter localisations."""

_LEAST = 0.5
"""The least share, of the boxes that the odometry covers, that a localisation with its continued poses must cover. With
fewer, the odometry is used alone. At 2/3, an MRCLAM drive whose localisation begins after two fifths of the time lost its
frame. With a larger share, fewer maps have the frame of the localisation."""


def continued_by_odometry(log: Log, settings: Settings, *, whole: bool = False) -> Log:
    """Return the log with a localisation that also has the poses of the odometry outside of its time and in its gaps.

    The continued poses join the localised poses at both ends of a gap. A gap of the odometry ends the continuation, because
    somebody may have moved the robot in it. The continuation also ends where the odometry has drifted too far. The log is
    returned unchanged if there is nothing to continue. It is also returned unchanged if more than the share `_MOST` of the
    boxes would lie on continued poses that are not `bridged`. whole: whether to continue as far as the odometry goes,
    without the limits of drift and `_MOST`, because the solve starts at other poses.
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
    sure, times = _near_localization(odometry, known, settings, np.inf if whole else _DRIFT)
    free = sure & ~_between(localization.stamps, odometry.stamps, max_gap)
    if not free.any():
        return log
    stamps = odometry.stamps[free]
    offset, _ = interpolate(known, map_T_odom, times[free], np.inf)
    every = np.concatenate([localization.stamps, stamps])
    poses = np.concatenate([localization.poses, offset @ odometry.poses[free]])
    order = np.argsort(every)
    continued = replace(log, localization=Trajectory(every[order], poses[order]))
    boxes = _stamps_of_boxes(log)
    more = _only_continued(log, continued, boxes, settings) & ~bridged(localization, odometry, boxes, settings)
    return continued if whole or more.sum() <= _MOST * _on_path(continued, boxes, settings).sum() else log


def without_short_localization(log: Log, settings: Settings) -> Log:
    """Return the log without its localisation, if the odometry alone has poses for far more boxes (`_LEAST`).

    The localisation counts with all poses that the odometry continues. Without it, the map has the frame of the odometry.
    """
    if log.localization is None or log.odometry is None:
        return log
    boxes = _stamps_of_boxes(log)
    driven = _between(log.odometry.stamps, boxes, settings.poses.max_gap)
    localized = _on_path(continued_by_odometry(log, settings), boxes, settings)
    return log if localized.sum() >= _LEAST * driven.sum() else replace(log, localization=None)


def bridged(localization: Trajectory, odometry: Trajectory, stamps: Floats, settings: Settings) -> Bools:
    """Return which stamps (Q,), s, lie between two poses of a localisation that the odometry joins to the stamp. The
    odometry must drift little from at least one of the two. It carried the pose that was measured at the nearer one to the
    stamp."""
    _, covered = interpolate(odometry.stamps, odometry.poses, localization.stamps, settings.poses.max_gap)
    known = localization.stamps[covered]
    if len(known) < 2 or not len(stamps):
        return np.zeros(len(stamps), dtype=bool)
    joined, sure, _ = _ends(odometry, known, stamps, settings, _DRIFT)
    return joined.all(axis=0) & sure.any(axis=0) & _between(odometry.stamps, stamps, settings.poses.max_gap)


def beside(localization: Trajectory, odometry: Trajectory, stamps: Floats, settings: Settings) -> Bools:
    """Return which stamps (Q,), s, the odometry joins to a pose of a localisation that is at most poses.max_gap away."""
    max_gap = settings.poses.max_gap
    _, covered = interpolate(odometry.stamps, odometry.poses, localization.stamps, max_gap)
    known = localization.stamps[covered]
    if not len(known) or not len(stamps):
        return np.zeros(len(stamps), dtype=bool)
    joined, _, at = _ends(odometry, known, stamps, settings, _DRIFT)
    near = joined & (np.abs(known[at] - stamps) <= max_gap)
    return np.asarray(near.any(axis=0)) & _between(odometry.stamps, stamps, max_gap)


def share_on_continuation(log: Log, continued: Log, settings: Settings) -> float:
    """Return the share of the boxes that have a pose in `continued`, from `continued_by_odometry`, but not in the log."""
    boxes = _stamps_of_boxes(log)
    more = _only_continued(log, continued, boxes, settings)
    return float(more.sum() / max(_on_path(continued, boxes, settings).sum(), 1))


def _stamps_of_boxes(log: Log) -> Floats:
    stamps = [c.detections.frame_stamps[c.detections.frame] for c in log.cameras if c.detections is not None]
    return np.concatenate([np.zeros(0), *stamps])


def _on_path(log: Log, stamps: Floats, settings: Settings) -> Bools:
    """Return which stamps (Q,), s, have a pose in the localisation of a log."""
    none = np.zeros(len(stamps), dtype=bool)
    return none if log.localization is None else _between(log.localization.stamps, stamps, settings.poses.max_gap)


def _only_continued(log: Log, continued: Log, stamps: Floats, settings: Settings) -> Bools:
    """Return which stamps (Q,), s, have a pose in `continued`, but not in the log."""
    if continued.localization is log.localization:
        return np.zeros(len(stamps), dtype=bool)
    return _on_path(continued, stamps, settings) & ~_on_path(log, stamps, settings)


def _between(poses: Floats, stamps: Floats, max_gap: float) -> Bools:
    """Return which stamps (Q,) are at one of the stamps of poses (N,), or between two that are at most max_gap apart (s)."""
    if len(poses) == 0:
        return np.zeros(len(stamps), dtype=bool)
    after = np.searchsorted(poses, stamps)
    before, next_ = poses[np.maximum(after - 1, 0)], poses[np.minimum(after, len(poses) - 1)]
    return (next_ == stamps) | ((before <= stamps) & (stamps <= next_) & (next_ - before <= max_gap))


def _near_localization(odometry: Trajectory, known: Floats, settings: Settings, drift: float) -> tuple[Bools, Floats]:
    """Return which poses of an odometry (N,) drifted little since the localised stamp before them, or until the one after.
    Also return the times (N,), s, at which the offset between odometry and map is taken for each pose. Between two localised
    stamps, this is the pose's own time. If only one of the two exists without a gap of the odometry in between, it is that
    stamp. known: (L,) s, the localised stamps. drift: rad, the largest.
    """
    joined, sure, at = _ends(odometry, known, odometry.stamps, settings, drift)
    own = np.where(joined[0], known[at[0]], known[at[1]])
    return np.asarray(sure.any(axis=0)), np.where(joined.all(axis=0), odometry.stamps, own)


def _ends(odometry: Trajectory, known: Floats, stamps: Floats, settings: Settings, most: float) -> tuple[Bools, Bools, Ints]:
    """Compare each of the stamps (Q,), s, with the localised stamp before it and the one after it. known: (L,) s, the
    localised stamps.

    most: rad, the largest drift. Returns three arrays (2, Q), for the localised stamp before and the one after: whether it
    exists without a gap of the odometry in between, whether the odometry also drifts little in between, and the index of the
    localised stamp.
    """
    drift, at_known = np.split(
        gathered_drift(odometry, np.concatenate([stamps, known]), settings.odometry)[:, 2, 2], [len(stamps)]
    )
    gap_ends = odometry.stamps[1:][np.diff(odometry.stamps) > settings.poses.max_gap]
    stretch, of_known = (np.searchsorted(gap_ends, of, side="right") for of in (stamps, known))
    after = np.searchsorted(known, stamps)
    ends = np.stack([after - 1, after])
    at = np.clip(ends, 0, len(known) - 1)
    joined = (ends == at) & (stretch == of_known[at])
    return joined, joined & (np.abs(drift - at_known[at]) < most**2), at
