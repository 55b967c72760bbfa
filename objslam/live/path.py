"""The last stretch of the robot's path, as a stream: poses between the stamps, and the drift gathered by then."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from objslam.config import Odometry
from objslam.geometry import interpolate, inverse
from objslam.keyframes import add_step
from objslam.types import Floats

_PLANAR = 1e-6  # by so much a pose may leave the plane of the first one, as `geometry.is_planar` has it


class PathBuffer:
    """Poses of base as they come, the newest `seconds` of them; drift is summed up in the frame of the first pose.

    planar: whether all of them so far keep one height, roll and pitch.
    """

    def __init__(self, settings: Odometry, seconds: float) -> None:
        self._settings, self._seconds = settings, seconds
        self._stamps: list[float] = []
        self._poses: list[Floats] = []
        self._drift: list[Floats] = []
        self._from_start = self._last = np.eye(4)
        self.planar = True
        self.newest = -np.inf

    def append(self, stamp: float, pose: Floats) -> None:
        """One more pose (4, 4), newer than all before; it and its drift are not to be changed."""
        if not self._stamps:
            self._from_start, drift = inverse(pose), np.zeros((6, 6))
            self._last = self._from_start @ pose
        else:
            last, self._last = self._last, self._from_start @ pose
            self.planar = self.planar and _upright(self._last)
            drift = add_step(self._drift[-1], last, self._last, self._settings, self.planar)
        self._stamps.append(stamp)
        self._poses.append(pose)
        self._drift.append(drift)
        self.newest = stamp
        half = len(self._stamps) // 2
        if self._stamps[half] < stamp - self._seconds:  # now and then, for it moves all that stays
            for column in (self._stamps, self._poses, self._drift):
                del column[:half]

    @property
    def oldest(self) -> float:
        """The stamp of the oldest pose, inf without any."""
        return self._stamps[0] if self._stamps else np.inf

    def at(self, stamp: float, max_gap: float) -> tuple[Floats, Floats] | None:
        """The pose (4, 4) at a stamp and the drift (6, 6) gathered by then; None outside the path or in a longer gap."""
        if not self.oldest <= stamp <= self.newest:
            return None
        after = bisect_left(self._stamps, stamp)
        if self._stamps[after] == stamp:
            return self._poses[after], self._drift[after]
        pair = slice(after - 1, after + 1)
        before, then = self._stamps[pair]
        poses, valid = interpolate(np.array([before, then]), np.array(self._poses[pair]), np.array([stamp]), max_gap)
        if not valid[0]:
            return None
        share = (stamp - before) / (then - before)
        return poses[0], (1 - share) * self._drift[after - 1] + share * self._drift[after]

    def from_start(self, pose: Floats) -> Floats:
        """A pose (4, 4) in the frame of the first one."""
        return np.asarray(self._from_start @ pose)


def _upright(pose: Floats) -> bool:
    x, y, z, height = pose[2].tolist()
    return max(abs(x), abs(y), abs(z - 1.0), abs(height)) <= _PLANAR
