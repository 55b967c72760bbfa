"""Correct known errors of the odometry: its scales ahead and sideways, and the scale, biases and slip of its turns."""

import math
from collections import deque
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lengths, motion_between
from objslam.core.rotation import rotation_vector
from objslam.core.trajectory import Trajectory
from objslam.frontend.odometry_bridge import OdometryBridge, bridge_of
from objslam.frontend.odometry_drift import DriftPath, PlanarSteps
from objslam.frontend.recent_values import RecentValues

_KINDS = ("scale", "turn_scale", "turn_bias", "turn_per_m", "turn_slip", "lateral_scale")
ODOMETRY = tuple(f"odometry.{one}" for one in _KINDS)
"""The names of the errors of odometry."""
_LEVEL = 1e-6
"""The largest tilt (rad) and change of height (m) of a path whose drift is computed in the plane. The drift of any other
path is computed in 3D, which takes longer. A larger value neglects more of a tilt."""
_CURVE = 0.5
"""The time (s) over which the curvature of a path is measured. Over a longer time, short curves count less. Over a shorter
time, the jitter of the headings of fast odometry looks like curves."""
_STANDS = 1e-6
"""The least way (m) within `_CURVE`. A shorter way, of a robot that stands or turns on the spot, is replaced by this value.
The value only avoids a division by zero."""
_STROKE = 0.5
"""The time (s) over which moves are summed before a robot is said to drive sideways. Over a longer time, the jitter of poses
counts less, but a robot that drives to and fro seems to stand."""
_SHARP = 0.3
"""Only steps with at most this turn (rad) show whether a robot drives sideways. If the whole turn is in one half of a step,
the step seems to go sideways by a quarter of the turn. With a larger value, coarse odometry looks like driving sideways."""
_SIDEWAYS = 0.05
"""A robot drives sideways if each direction has at least this share of its way. If the way in a direction with this share is
20 % too long, the path is 1 % too long, which is within the prior of the other scale. With a larger share, robots that
seldom drive sideways have no lateral scale."""
_KEPT = 6
"""The number of corrected paths that are kept, for the last values of turn scale, biases, slip and lateral scale. A round of
derivatives needs six: the present path, and one for each error. A larger number takes more memory."""


def corrected_odometry(odometry: Trajectory, error: Mapping[str, float]) -> Trajectory:
    """Return the odometry with the lengths and the turns of its steps corrected. Its first pose does not change."""
    return CorrectablePath(odometry).path(error)


class CorrectablePath:
    """Odometry that is corrected for many values of its errors. The parts that no error changes are computed once."""

    def __init__(self, odometry: Trajectory) -> None:
        """Measure the steps of the odometry."""
        self.odometry = odometry
        rotation, places = odometry.poses[:, :3, :3], odometry.poses[:, :3, 3]
        if odometry.travel is None:
            turn = rotation_vector(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))[:, 2]  # About the vertical axis.
        else:  # The turn may be several rounds.
            turn = odometry.travel[1:, 2]
        self._turned = np.append(0.0, np.cumsum(turn))
        self._seconds = odometry.stamps - odometry.stamps[0]
        self._ways = np.ascontiguousarray(np.diff(places, axis=0).T)
        level = max(np.abs(rotation[:, :2, 2]).max(), np.abs(places[:, 2] - places[0, 2]).max()) <= _LEVEL
        self._heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]) if level else None
        self._moved = RecentValues[tuple[Floats, Floats]](_KEPT)

    @cached_property
    def _curvature(self) -> Floats:
        """(N-1,) rad/m, how sharply the path turns in each step.

        The curvature is the mean over the time `_CURVE` around the middle of the step. So jitter of the headings does not
        look like curves.
        """
        middle, seconds = (self._seconds[1:] + self._seconds[:-1]) / 2, self._seconds
        travel = self.odometry.travel
        way = np.append(0.0, np.cumsum(np.hypot(*self._ways[:2]) if travel is None else travel[1:, 0]))
        turned, driven = (
            np.interp(middle + _CURVE / 2, seconds, total) - np.interp(middle - _CURVE / 2, seconds, total)
            for total in (self._turned, way)
        )
        return np.asarray(np.abs(turned) / np.maximum(driven, _STANDS))

    @cached_property
    def _driven(self) -> Floats:
        """(N,) m, how far the robot has driven ahead since the first pose. Driving backwards counts as negative."""
        x, y, _ = self._ways
        left_x, left_y = self._left
        ahead = left_y * x - left_x * y
        if self.odometry.travel is not None:
            ahead = np.copysign(self.odometry.travel[1:, 0], ahead)
        return np.append(0.0, np.cumsum(ahead))

    @cached_property
    def sideways(self) -> Floats:
        """(N-1,) m, how far each step goes to the left.

        A robot that cannot drive sideways moves along the mean of the headings at both ends of a step.
        """
        x, y, _ = self._ways
        left_x, left_y = self._left
        return np.asarray(left_x * x + left_y * y)

    @cached_property
    def drives_sideways(self) -> bool:
        """Whether the robot drives in all directions, as with mecanum wheels, omni wheels or legs. The path must be planar.

        The moves of base are summed over the time `_STROKE`, so the jitter of poses counts little. If base is not on the
        axis of the wheels, it moves sideways in turns. So the part of the moves that is proportional to the turns does not
        count. The axes of base may not point along the wheels. So the direction with the least moves counts. Steps with a
        sharp turn do not count, because the heading of their moves is unknown.
        """
        left_x, left_y = self._left
        x, y, _ = self._ways
        steps = np.column_stack([left_y * x - left_x * y, self.sideways, np.diff(self._turned)])
        steps[np.abs(steps[:, 2]) > _SHARP] = 0.0
        stroke = np.floor(self._seconds[1:] / _STROKE)
        moves = np.add.reduceat(steps, np.flatnonzero(np.diff(stroke, prepend=-1.0)), axis=0)
        moves, turns = moves[:, :2], moves[:, 2]
        rest = moves - np.outer(turns, turns @ moves / max(float(turns @ turns), _STANDS))
        _, axes = np.linalg.eigh(rest.T @ rest)
        return bool(np.abs(rest @ axes[:, 0]).sum() > _SIDEWAYS * lengths(moves).sum())

    @cached_property
    def _left(self) -> Floats:
        """(2, N-1) the unit vectors to the left, halfway through each step."""
        ahead, turn = self.odometry.poses[:-1, :2, 0], np.diff(self._turned)
        middle = np.arctan2(ahead[:, 1], ahead[:, 0]) + np.arctan2(np.sin(turn), np.cos(turn)) / 2
        return np.stack([-np.sin(middle), np.cos(middle)])

    @cached_property
    def bridge(self) -> OdometryBridge:
        """How far the robot may be from the interpolated path. The errors of the odometry hardly change this."""
        return bridge_of(self.odometry)

    def path(self, error: Mapping[str, float]) -> Trajectory:
        """Return the corrected path, as `corrected_odometry` does."""
        travel = self.odometry.travel
        if travel is not None:
            scale, turn_scale, turn_bias, per_m, slip, lateral = (error.get(name, 0.0) for name in ODOMETRY)
            bias = np.diff(turn_bias * self._seconds + per_m * self._driven, prepend=0.0)
            turn = (1 + turn_scale) * travel[:, 2] + bias
            longer = (1 + scale) * np.append(1.0, gripping(slip, self._curvature) * self._longer_by(lateral))
            travel = np.stack([longer * travel[:, 0], np.abs(1 + turn_scale) * travel[:, 1], turn], axis=1)
        return Trajectory(self.odometry.stamps, self.poses(error), travel)

    def poses(self, error: Mapping[str, float], which: Ints | None = None) -> Floats:
        """Return the corrected poses (n, 4, 4) with the indices `which`, or all poses, as `corrected_odometry` does."""
        scale, *others = (error.get(name, 0.0) for name in ODOMETRY)
        poses = self.odometry.poses if which is None else self.odometry.poses[which]
        if scale == 0 and not any(others):
            return poses
        more, places = self._headings_and_places(*others)
        places = places if which is None else places[:, which]
        places = self.odometry.poses[0, :3, 3, None] + (1 + scale) * places
        more = more if which is None else more[which]
        cos, sin = np.cos(more)[:, None], np.sin(more)[:, None]
        corrected = poses.copy()
        corrected[:, 0, :3] = cos * poses[:, 0, :3] - sin * poses[:, 1, :3]
        corrected[:, 1, :3] = sin * poses[:, 0, :3] + cos * poses[:, 1, :3]
        corrected[:, :3, 3] = places.T
        return corrected

    def drift(self, error: Mapping[str, float]) -> DriftPath:
        """Return the steps of the corrected path, from which its drift is computed."""
        scale, *others = (error.get(name, 0.0) for name in ODOMETRY)
        if self._heading is None or self.odometry.travel is not None:
            return DriftPath.of(self.path(error))
        more, (x, y, _) = self._headings_and_places(*others)
        heading, (begin, *_) = self._heading + more - self._heading[0], self._heading
        c, s = (1 + scale) * np.cos(begin), (1 + scale) * np.sin(begin)
        steps = PlanarSteps.between(np.cos(heading), np.sin(heading), c * x + s * y, c * y - s * x)
        return DriftPath(None, self.odometry.stamps, steps.sums())

    def _longer_by(self, lateral: float) -> Floats:
        """Return the factors (N-1,) by which a lateral scale makes the steps longer."""
        share = self.sideways**2 / np.maximum((self._ways[:2] ** 2).sum(axis=0), _STANDS**2)
        return np.sqrt(1 + (lateral**2 + 2 * lateral) * share)

    def _headings_and_places(
        self, turn_scale: float, turn_bias: float, per_m: float, slip: float, lateral: float
    ) -> tuple[Floats, Floats]:
        """Return two arrays: the change (N,), rad, of each heading by the errors, and the corrected places (3, N), m, seen
        from the first pose.

        The scale is not in the places, because it only multiplies them.
        """

        def compute() -> tuple[Floats, Floats]:
            more = turn_scale * self._turned + turn_bias * self._seconds
            if per_m != 0:
                more = more + per_m * self._driven
            middle = (more[1:] + more[:-1]) / 2  # The chord of an arc points along the mean of the two headings at its ends.
            cos, sin = np.cos(middle), np.sin(middle)
            x, y, z = self._ways if lateral == 0 else self._ways_with(lateral)
            if slip != 0:
                x, y, z = np.stack([x, y, z]) * gripping(slip, self._curvature)
            places = np.zeros((3, len(more)))
            places[0, 1:], places[1, 1:], places[2, 1:] = cos * x - sin * y, sin * x + cos * y, z
            return more, np.cumsum(places, axis=1, out=places)

        return self._moved.get((turn_scale, turn_bias, per_m, slip, lateral), compute)

    def _ways_with(self, lateral: float) -> Floats:
        """Return the steps (3, N-1), m, with a lateral scale."""
        ways = self._ways.copy()
        ways[:2] += lateral * self.sideways * self._left
        return ways


def gripping(slip: float, curvature: Floats) -> Floats:
    """Return the ratio (...) of the true length of steps to the length in the odometry, from 0 to 2.

    slip: m/rad, the excess of a length in the odometry for each radian of turning. curvature: (...) rad/m of the path,
    positive.
    """
    return np.asarray(np.clip(1 - slip * curvature, 0.0, 2.0))


class OdometryCorrection:
    """Corrects odometry pose by pose, as it arrives, like `corrected_odometry` does for a whole path. The first pose does
    not change.

    A session corrects every pose. This takes a fraction of the time of `corrected_odometry`, and avoids numpy, with which a
    pose takes four times as long.
    """

    def __init__(
        self, error: Mapping[str, float], said: Trajectory | None = None, corrected: Trajectory | None = None
    ) -> None:
        """Start a correction. error: the errors by name.

        said, corrected: the path so far, as sent by the robot and as corrected. Both are None at the start of a path.
        """
        self._scale, *others = (error.get(name, 0.0) for name in ODOMETRY)
        self._turn_scale, self._turn_bias, self._per_m, self._slip, self._lateral = others
        self._none = self._scale == 0 and not any(others)
        self._recent: deque[tuple[float, float, float]] = deque([(-math.inf, 0.0, 0.0)])
        self._stamp: float | None = None
        self._before = np.eye(4)
        self._place = 0.0, 0.0, 0.0
        self._turned = 0.0
        if said is not None and corrected is not None:
            self._stamp, self._before = float(said.stamps[-1]), said.poses[-1]
            self._place = _place_of(corrected.poses[-1])
            turn = corrected.poses[-1, :3, :3] @ said.poses[-1, :3, :3].T
            self._turned = math.atan2(turn[1, 0], turn[0, 0])

    def correct(self, stamp: float, pose: Floats) -> Floats:
        """Return the next pose (4, 4), corrected. stamp: s."""
        if self._none:
            return pose
        if self._stamp is None:
            self._stamp, self._before, self._place = stamp, pose, _place_of(pose)
            return pose
        (_, _, up), angle, (x, y, z) = motion_between(self._before, pose)
        if angle < math.pi / 2:  # The sine of an angle near pi is small, so that the axis would be inexact.
            turn = up * angle / math.sin(angle) if angle > 0 else 0.0
        else:
            turn = float(rotation_vector(pose[:3, :3] @ self._before[:3, :3].T)[2])
        more = self._turn_scale * turn + self._turn_bias * (stamp - self._stamp)
        heading = math.atan2(float(self._before[1, 0]), float(self._before[0, 0])) + turn / 2
        left_x, left_y = -math.sin(heading), math.cos(heading)
        more += self._per_m * (left_y * x - left_x * y)
        middle = self._turned + more / 2  # as in `CorrectablePath`
        if self._lateral:
            longer_left = self._lateral * (left_x * x + left_y * y)
            x, y = x + longer_left * left_x, y + longer_left * left_y
        longer = (1 + self._scale) * self._grip(stamp, turn, math.hypot(x, y))
        c, s, (px, py, pz) = longer * math.cos(middle), longer * math.sin(middle), self._place
        self._place = px, py, pz = px + c * x - s * y, py + s * x + c * y, pz + longer * z
        self._turned += more
        self._stamp, self._before = stamp, pose
        c, s = math.cos(self._turned), math.sin(self._turned)
        (a0, a1, a2, _), (b0, b1, b2, _), (c0, c1, c2, _) = pose[:3].tolist()
        return np.array(
            [
                [c * a0 - s * b0, c * a1 - s * b1, c * a2 - s * b2, px],
                [s * a0 + c * b0, s * a1 + c * b1, s * a2 + c * b2, py],
                [c0, c1, c2, pz],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )

    def _grip(self, stamp: float, turn: float, way: float) -> float:
        """Return what `gripping` does for the step that ends at a stamp, s. turn: rad. way: m.

        The curvature is the mean over the last `_CURVE` seconds, because later steps are unknown.
        """
        if self._slip == 0:
            return 1.0
        _, turned, driven = self._recent[-1]
        self._recent.append((stamp, turned + turn, driven + way))
        while len(self._recent) > 2 and self._recent[1][0] <= stamp - _CURVE:
            self._recent.popleft()
        (_, turned, driven), (_, turned_now, driven_now) = self._recent[0], self._recent[-1]
        curvature = abs(turned_now - turned) / max(driven_now - driven, _STANDS)
        return min(max(1 - self._slip * curvature, 0.0), 2.0)


def _place_of(pose: Floats) -> tuple[float, float, float]:
    x, y, z = pose[:3, 3].tolist()
    return x, y, z
