"""A buffer of the newest poses of a path, with interpolation and accumulated drift."""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from objslam.config import Odometry
from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, interpolate_pair, inverse
from objslam.core.trajectory import Trajectory
from objslam.frontend.odometry_drift import add_step, gathered_drift

_PLANAR = 1e-6  # The tolerance (m, rad) of a planar path. A larger value accepts more paths.


class OnPath(NamedTuple):
    """A pose (4, 4) on a path, the drift (6, 6) accumulated up to this pose, and the number of the path's stretch."""

    pose: Floats
    drift: Floats
    stretch: int


class PathBuffer:
    """The robot's poses in the last `seconds` of a path. Drift accumulates in the coordinate frame of the first pose.

    max_gap: s. A longer gap ends a stretch of the path, and no pose is interpolated in such a gap. planar: whether all poses
    so far have one height, roll and pitch. newest: the stamp of the newest pose, s. stretch_begin: the first stamp of the
    newest stretch, s, inf without poses.
    """

    def __init__(self, settings: Odometry, seconds: float, max_gap: float) -> None:
        self._settings, self._seconds, self._max_gap = settings, seconds, max_gap
        self._stamps: list[float] = []
        self._path: list[OnPath] = []
        self._from_start = self._last = np.eye(4)
        self.planar = True
        self.newest = -np.inf
        self.stretch_begin = np.inf

    def append(self, stamp: float, pose: Floats) -> None:
        """Append a pose (4, 4) at a stamp, s, later than all others. The caller must not change its array."""
        if not self._stamps:
            self._from_start, drift, stretch = inverse(pose), np.zeros((6, 6)), 0
            self._last = self._from_start @ pose
        else:
            last, self._last = self._last, self._from_start @ pose
            x, y, z, height = self._last[2].tolist()
            self.planar = self.planar and max(abs(x), abs(y), abs(z - 1.0), abs(height)) <= _PLANAR
            drift = add_step(self._path[-1].drift, last, self._last, self._settings, self.planar)
            stretch = self._path[-1].stretch + (stamp - self.newest > self._max_gap)
        if not self._path or stretch != self._path[-1].stretch:
            self.stretch_begin = stamp
        self._stamps.append(stamp)
        self._path.append(OnPath(pose, drift, stretch))
        self.newest = stamp
        half = len(self._stamps) // 2
        if self._stamps[half] < stamp - self._seconds:  # Each deletion moves all other poses, so it must be rare.
            del self._stamps[:half], self._path[:half]

    def replace(self, path: Trajectory, settings: Odometry) -> None:
        """Replace the kept poses by poses of another path, which must begin at the first stamp that was ever appended."""
        if not self._stamps:
            return
        self._settings, self._from_start = settings, inverse(path.poses[0])
        poses, _ = interpolate(path.stamps, path.poses, np.array(self._stamps), np.inf)
        drift = gathered_drift(path, np.array(self._stamps), settings)
        stretches = [on.stretch for on in self._path]
        self._path = [OnPath(*on) for on in zip(poses, drift, stretches, strict=True)]
        self._last = self._from_start @ poses[-1]

    @property
    def oldest(self) -> float:
        """The stamp of the oldest pose, s. It is inf without poses."""
        return self._stamps[0] if self._stamps else np.inf

    def stretch(self, stamp: float) -> int | None:
        """Return the number of the stretch at a stamp, s. Return None outside the path or in a gap longer than max_gap."""
        if not self.oldest <= stamp <= self.newest:
            return None
        after = bisect_left(self._stamps, stamp)
        on = self._path[after].stretch
        return on if self._stamps[after] == stamp or self._path[after - 1].stretch == on else None

    def at(self, stamp: float) -> OnPath | None:
        """Return the interpolated pose and drift at a stamp, s. Return None outside the path or in a gap longer than
        max_gap."""
        stretch = self.stretch(stamp)
        if stretch is None:
            return None
        after = bisect_left(self._stamps, stamp)
        if self._stamps[after] == stamp:
            return self._path[after]
        (begin, end), (before, then) = self._stamps[after - 1 : after + 1], self._path[after - 1 : after + 1]
        share = (stamp - begin) / (end - begin)
        pose = interpolate_pair(before.pose, then.pose, share)
        return OnPath(pose, (1 - share) * before.drift + share * then.drift, stretch)

    def from_start(self, pose: Floats) -> Floats:
        """Return a pose (4, 4) in the coordinate frame of the first pose."""
        return np.asarray(self._from_start @ pose)
