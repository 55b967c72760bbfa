"""Tests of the stamps of a log: are they in seconds, and do the frames fit the times of the poses?"""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.core.validity import MAX_LIVE_STAMP, UNITS_OF_TIME, unit_of_date
from objslam.mapping.checks.finding import Finding

_OVERLAP = 0.5
"""The least share of frames within the time of the poses. A larger share also reports logs that begin late."""
_RARE = 10.0
"""The median time (s) between two poses or frames from which their stamps are probably not in s. At 10 s, a robot hardly
measures its way. A larger value finds fewer stamps in ms, whose usual steps are 10 to 1000."""
_CRAWL = 0.01
"""The mean speed (m/s) of a robot below which its stamps are probably not in s. Even a lawn mower is 30 times as fast. A
larger value accuses more robots that hardly drive."""

_FASTEST = 1e-4
"""The least median time (s) between two poses, or between two frames of a camera, after a correction of the unit. If stamps
in s are corrected by mistake, this time gets shorter. A larger value finds fewer wrong units."""


def check_stamps(log: Log) -> Finding | None:
    """Return a finding if the stamps of a log are not in s, or if its frames were taken at other times than its poses."""
    path = _longest(log)
    stamps = [c.detections.frame_stamps for c in log.cameras if c.detections is not None]
    if path is None or not stamps or not sum(map(len, stamps)):
        return None
    frames = np.concatenate(stamps)
    span = f"frames {frames.min():.3f} to {frames.max():.3f}, poses {path.stamps[0]:.3f} to {path.stamps[-1]:.3f}"

    def share(factor: float) -> float:
        inside = (frames / factor >= path.stamps[0] - 1) & (frames / factor <= path.stamps[-1] + 1)
        return float(inside.mean())

    here = share(1.0)
    if here >= _OVERLAP:
        common = _common_unit(path, stamps)
        said = f"all stamps are probably in {common} instead of s ({span})"
        return None if common is None else Finding("stamps unit", said)
    for factor, unit in UNITS_OF_TIME.items():
        for by, who in ((factor, "frames"), (1 / factor, "poses")):
            steps = [np.median(np.diff(s)) for s in (stamps if who == "frames" else [path.stamps]) if len(s) > 1]
            if share(by) > max(_OVERLAP, 2 * here) and all(step > factor * _FASTEST for step in steps):
                return Finding("stamps unit", f"the stamps of the {who} are probably in {unit} instead of s ({span})")
    length, whole = float(np.ptp(frames)), float(np.ptp(path.stamps))
    for factor, unit in UNITS_OF_TIME.items():
        for ratio, who in ((length / max(whole, 1e-9), "frames"), (whole / max(length, 1e-9), "poses")):
            if 0.5 < ratio / factor < 2:
                return Finding("stamps unit", f"the stamps of the {who} are probably in {unit} instead of s ({span})")
    what = f"only {100 * here:.0f} % of the frames lie in the time of the poses ({span})"
    return Finding("stamps apart", f"{what}: the camera and the poses have different clocks", spoils=False)


def _longest(log: Log) -> Trajectory | None:
    """Return the path whose stamps are tested: the localisation, or the odometry if the localisation lies within its time.

    A localisation that begins late does not have another clock. None if the log has neither path.
    """
    path, odometry = log.localization, log.odometry
    if not path or not odometry:
        return path or odometry
    return odometry if odometry.stamps[0] <= path.stamps[0] and path.stamps[-1] <= odometry.stamps[-1] else path


def _common_unit(path: Trajectory, frames: list[Floats]) -> str | None:
    """Return the common unit of the stamps of poses and frames, None for seconds. frames: the stamps (F,) of each camera.

    A date in ms is larger than any date in s. If the stamps begin at zero, two other signs together show that they are not
    in s: the times between them are too long, and the robot seems to crawl.
    """
    last = float(path.stamps[-1])
    if last > MAX_LIVE_STAMP:
        return unit_of_date(last)
    usual = min((float(np.median(np.diff(s))) for s in (path.stamps, *frames) if len(s) > 1), default=0.0)
    way = float(np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1).sum())
    if usual < _RARE or not 0 < way < _CRAWL * float(np.ptp(path.stamps)):
        return None
    return next(unit for factor, unit in reversed(UNITS_OF_TIME.items()) if usual >= _RARE * factor / 1e3)
