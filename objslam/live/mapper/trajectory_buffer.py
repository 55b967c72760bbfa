"""The last stretch of the robot's path, as a stream: poses between the stamps, and the drift gathered by then."""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from objslam.config import Odometry
from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.frontend.odometry_drift import add_step

_PLANAR = 1e-6
"""m and rad by which a pose may leave the plane of the first one, as in `geometry.is_planar`; larger calls more planar."""


class OnPath(NamedTuple):
    """Where a path has the robot at a stamp: pose (4, 4), drift (6, 6) gathered by then, number of the stretch."""

    pose: Floats
    drift: Floats
    stretch: int


class PathBuffer:
    """Poses of base as they come, the newest `seconds` of them; drift is summed up in the frame of the first pose.

    max_gap: s; a longer gap between two poses ends a stretch, and nothing is read off it.
    planar: whether all of them so far keep one height, roll and pitch. stretch_begin: the stamp that the newest stretch
    begins at, inf without any.
    """

    def __init__(self, settings: Odometry, seconds: float, max_gap: float) -> None:
        self._settings, self._seconds, self._max_gap = settings, seconds, max_gap
        self._stamps: list[float] = []
        self._poses: list[Floats] = []
        self._drift: list[Floats] = []
        self._stretch: list[int] = []
        self._from_start = self._last = np.eye(4)
        self.planar = True
        self.newest = -np.inf
        self.stretch_begin = np.inf

    def append(self, stamp: float, pose: Floats) -> None:
        """One more pose (4, 4), newer than all before; it and its drift are not to be changed."""
        if not self._stamps:
            self._from_start, drift, stretch = inverse(pose), np.zeros((6, 6)), 0
            self._last = self._from_start @ pose
        else:
            last, self._last = self._last, self._from_start @ pose
            self.planar = self.planar and _upright(self._last)
            drift = add_step(self._drift[-1], last, self._last, self._settings, self.planar)
            stretch = self._stretch[-1] + (stamp - self.newest > self._max_gap)
        if not self._stretch or stretch != self._stretch[-1]:
            self.stretch_begin = stamp
        self._stamps.append(stamp)
        self._poses.append(pose)
        self._drift.append(drift)
        self._stretch.append(stretch)
        self.newest = stamp
        half = len(self._stamps) // 2
        if self._stamps[half] < stamp - self._seconds:  # now and then, for it moves all that stays
            for column in (self._stamps, self._poses, self._drift, self._stretch):
                del column[:half]

    @property
    def oldest(self) -> float:
        """The stamp of the oldest pose, inf without any."""
        return self._stamps[0] if self._stamps else np.inf

    def stretch(self, stamp: float) -> int | None:
        """The number of the stretch that a stamp lies on; None outside the path or in a gap that is too long."""
        if not self.oldest <= stamp <= self.newest:
            return None
        after = bisect_left(self._stamps, stamp)
        on = self._stretch[after]
        return on if self._stamps[after] == stamp or self._stretch[after - 1] == on else None

    def at(self, stamp: float) -> OnPath | None:
        """Where the robot was at a stamp; None outside the path or in a gap that is too long."""
        stretch = self.stretch(stamp)
        if stretch is None:
            return None
        after = bisect_left(self._stamps, stamp)
        if self._stamps[after] == stamp:
            return OnPath(self._poses[after], self._drift[after], stretch)
        pair = slice(after - 1, after + 1)
        before, then = self._stamps[pair]
        poses, _ = interpolate(np.array([before, then]), np.array(self._poses[pair]), np.array([stamp]), self._max_gap)
        share = (stamp - before) / (then - before)
        return OnPath(poses[0], (1 - share) * self._drift[after - 1] + share * self._drift[after], stretch)

    def from_start(self, pose: Floats) -> Floats:
        """A pose (4, 4) in the frame of the first one."""
        return np.asarray(self._from_start @ pose)


def _upright(pose: Floats) -> bool:
    x, y, z, height = pose[2].tolist()
    return max(abs(x), abs(y), abs(z - 1.0), abs(height)) <= _PLANAR
