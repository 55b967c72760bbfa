"""The last stretch of the robot's path, as a stream: poses between the stamps, and the drift gathered by then."""

from __future__ import annotations

import numpy as np

from objslam.config import Odometry
from objslam.geometry import interpolate, inverse
from objslam.keyframes import step_drift
from objslam.live.table import Table
from objslam.types import Floats

_UPRIGHT = np.array([0.0, 0.0, 1.0, 0.0])  # the third row of a pose in the plane of the first one,
_PLANAR = 1e-6  # to so much, as `geometry.is_planar` has it
_CHUNK = 512  # poses that may wait until they are worked in


class PathBuffer:
    """Poses of base as they come, the newest `seconds` of them; drift is summed up in the frame of the first pose.

    planar: whether all of them so far keep one height, roll and pitch.
    """

    def __init__(self, settings: Odometry, seconds: float) -> None:
        self._settings, self._seconds = settings, seconds
        self._path = Table(stamp=(np.float64, ()), pose=(np.float64, (4, 4)), drift=(np.float64, (6, 6)))
        self._new: list[tuple[float, Floats]] = []
        self._from_start = np.eye(4)
        self.planar = True
        self.newest = -np.inf

    def append(self, stamp: float, pose: Floats) -> None:
        """One more pose (4, 4), newer than all before."""
        if not len(self._path) and not self._new:
            self._from_start = inverse(pose)
        self._new.append((stamp, pose))
        self.newest = stamp
        if len(self._new) >= _CHUNK:
            self._work_in()

    @property
    def oldest(self) -> float:
        """The stamp of the oldest pose, inf without any."""
        if len(self._path):
            return float(self._path.stamp[0])
        return self._new[0][0] if self._new else np.inf

    def at(self, stamp: float, max_gap: float) -> tuple[Floats, Floats] | None:
        """The pose (4, 4) at a stamp and the drift (6, 6) gathered by then; None outside the path or in a longer gap."""
        self._work_in()
        stamps, path_poses, path_drift = self._path.stamp, self._path.pose, self._path.drift
        if not len(stamps) or not stamps[0] <= stamp <= stamps[-1]:
            return None
        after = int(np.searchsorted(stamps, stamp))
        if stamps[after] == stamp:
            return path_poses[after].copy(), path_drift[after].copy()
        pair = slice(after - 1, after + 1)
        poses, valid = interpolate(stamps[pair], path_poses[pair], np.array([stamp]), max_gap)
        if not valid[0]:
            return None
        before, then = stamps[pair][0], stamps[pair][-1]
        share = (stamp - before) / (then - before) if then > before else 0.0
        drift = path_drift[pair]
        return poses[0], np.asarray((1 - share) * drift[0] + share * drift[-1])

    def from_start(self, pose: Floats) -> Floats:
        """A pose (4, 4) in the frame of the first one."""
        return np.asarray(self._from_start @ pose)

    def _work_in(self) -> None:
        if not self._new:
            return
        stamps = np.array([stamp for stamp, _ in self._new])
        poses = np.array([pose for _, pose in self._new])
        self._new.clear()
        path = self._path
        if len(path):
            joined, total = self._from_start @ np.concatenate([path.pose[-1:], poses]), path.drift[-1]
        else:
            joined, total = self._from_start @ poses, np.zeros((6, 6))
        self.planar = self.planar and float(np.abs(joined[:, 2] - _UPRIGHT).max()) <= _PLANAR
        drift = total + np.cumsum(step_drift(joined, self._settings, self.planar), axis=0)
        if not len(path):
            drift = np.concatenate([total[None], drift])
        path.add(stamp=stamps, pose=poses, drift=drift)
        old = int(np.searchsorted(path.stamp, self.newest - self._seconds)) - 1
        if old > len(path) / 2:  # now and then, for it moves all that stays
            path.keep(np.arange(len(path)) >= old)
