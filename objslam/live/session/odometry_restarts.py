"""Keeps the odometry of a session in one coordinate frame, even if the robot's odometry restarts."""

import math

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, motion_between
from objslam.frontend.odometry_restarts import counts_from_zero
from objslam.live.counters import Counters

_JUMP = 0.1  # The excess of a step over live.max_speed, m, that shows a restart. A larger value misses more restarts.
_TURN = 0.3  # The excess of a turn over _TURNS_PER_M, rad, that shows a restart. A larger value misses more restarts.
_TURNS_PER_M = 4.0  # The allowed turn rate, rad/s, per m/s of live.max_speed. A larger value misses more restarts.


class OdometryRestarts:
    """Finds restarts of the robot's odometry, and moves the poses after them so that they continue the old path.

    start_T_odom: (4, 4) moves poses from the odometry's present frame into its first one.
    """

    def __init__(self, settings: Settings, counters: Counters) -> None:
        self._max_gap, self._fast, self._counters = settings.poses.max_gap, settings.live.max_speed, counters
        self.start_T_odom = np.eye(4)

    def continued(self, odom_T_base: Floats, last: Floats | None, gap: float) -> tuple[Floats, bool]:
        """Return a pose (4, 4) in the frame of the first odometry, and whether the odometry has restarted before this pose.

        last: the previous pose (4, 4), in the frame of the first odometry, or None. gap: the time since the previous pose,
        s.
        """
        pose = np.asarray(self.start_T_odom @ odom_T_base)
        if last is None:
            return pose, False
        if gap > self._max_gap:
            self._counters.accept("gaps of the odometry")
        if not self._jumped(odom_T_base, pose, last, gap):
            return pose, False
        self._counters.accept("restarts of the odometry")
        self.start_T_odom = last @ inverse(odom_T_base)
        return np.asarray(self.start_T_odom @ odom_T_base), True

    def _jumped(self, odom_T_base: Floats, pose: Floats, last: Floats, gap: float) -> bool:
        """Return whether the motion is too large for any robot, or the odometry begins at 0 again after a gap."""
        moved = motion_between(last, pose)
        way, turn = math.hypot(*moved.way), moved.angle
        if way > self._fast * gap + _JUMP or turn > _TURNS_PER_M * self._fast * gap + _TURN:
            return True
        return gap > self._max_gap and bool(counts_from_zero(inverse(self.start_T_odom) @ last, odom_T_base))
