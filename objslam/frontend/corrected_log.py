"""Correct known shared errors in a log, or in one part of it: odometry, cameras, directions, or stamps of frames."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lengths, make_pose, motion_between
from objslam.core.rotation import rotation_from_vector, rotation_vector
from objslam.core.types import CameraLog, Images, Log, Trajectory
from objslam.frontend.odometry_bridge import OdometryBridge, bridge_of
from objslam.frontend.odometry_drift import DriftPath, PlanarSteps
from objslam.frontend.recent_values import RecentValues
from objslam.frontend.surface_ranges import corrected_ranges

ODOMETRY = ("odometry.scale", "odometry.turn_scale", "odometry.turn_bias", "odometry.turn_slip")
"""The errors of odometry."""
AXES = ("roll", "tilt", "yaw")
"""The rotations of a camera on the robot, about the axes x, y and z of base."""
LENS = ("focal", "cx", "cy")
"""The errors of a camera matrix. The focal length is too short by the share `focal`. The image centre is too far left by cx
and too far up by cy, both as shares of the focal length."""
_SQUEEZED = 1e-3
"""A clock offset may move frames beyond an end of the path. They are placed within this time (s) of that end. A larger value
moves more frames. With a smaller value, stamps of fast cameras become equal, because float64 resolves Unix time to 0.2
us."""
_LEVEL = 1e-6
"""The largest tilt (rad) and change of height (m) of a path whose drift is computed in the plane. The drift of any other
path is computed in 3D, which takes longer. A larger value neglects more of a tilt."""
_CURVE = 0.5
"""The time (s) over which the curvature of a path is measured. Over a longer time, short curves count less. Over a shorter
time, the jitter of the headings of fast odometry looks like curves."""
_STANDS = 1e-6
"""A shorter way (m) within `_CURVE` counts as this: the robot stands or turns on the spot. It only avoids a division by
zero."""
_AHEAD = np.array([[0.0, 0.0, 1.0]])  # The direction along which depths are measured, in the camera frame.
_KEPT = 4
"""For how many turn scales, biases and slips the corrected path is kept. A round of derivatives needs four: the present
path, and one for each of these errors. A larger number takes more memory."""


def take_out(log: Log, error: Mapping[str, float], *, stay: bool = False) -> Log:
    """Return the log corrected by known errors: odometry, cameras, and stamps and depths of frames.

    error: values by name, as in `Calibration`. An absent name is 0. stay: whether frames on the path stay on it (see
    `later`). If False, a clock offset may move frames beyond an end of the path.
    """
    path, odometry = log.robot_path if stay else None, log.odometry
    if odometry is not None:
        odometry = corrected_odometry(odometry, error)
    cameras = tuple(corrected_camera(one, error, path) for one in log.cameras)
    return replace(log, odometry=odometry, cameras=cameras)


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
        else:  # It may be several rounds.
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

        It is the mean over the time `_CURVE` around the middle of the step. So the jitter of headings does not look like
        curves.
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
    def bridge(self) -> OdometryBridge:
        """How far the path may be from the interpolated path. The errors hardly change this."""
        return bridge_of(self.odometry)

    def path(self, error: Mapping[str, float]) -> Trajectory:
        """Return the corrected path, as `corrected_odometry` does."""
        travel = self.odometry.travel
        if travel is not None:
            scale, turn_scale, turn_bias, slip = (error.get(name, 0.0) for name in ODOMETRY)
            bias = turn_bias * np.diff(self._seconds, prepend=0.0)
            turn = (1 + turn_scale) * travel[:, 2] + bias
            longer = (1 + scale) * np.append(1.0, gripping(slip, self._curvature))
            travel = np.stack([longer * travel[:, 0], np.abs(1 + turn_scale) * travel[:, 1], turn], axis=1)
        return Trajectory(self.odometry.stamps, self.poses(error), travel)

    def poses(self, error: Mapping[str, float], which: Ints | None = None) -> Floats:
        """Return the corrected poses (n, 4, 4) with the indices `which`, or all poses, as `corrected_odometry` does."""
        scale, turn_scale, turn_bias, slip = (error.get(name, 0.0) for name in ODOMETRY)
        poses = self.odometry.poses if which is None else self.odometry.poses[which]
        if scale == turn_scale == turn_bias == slip == 0:
            return poses
        more, places = self._headings_and_places(turn_scale, turn_bias, slip)
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
        scale, turn_scale, turn_bias, slip = (error.get(name, 0.0) for name in ODOMETRY)
        if self._heading is None or self.odometry.travel is not None:
            return DriftPath.of(self.path(error))
        more, (x, y, _) = self._headings_and_places(turn_scale, turn_bias, slip)
        heading, (begin, *_) = self._heading + more - self._heading[0], self._heading
        c, s = (1 + scale) * np.cos(begin), (1 + scale) * np.sin(begin)
        steps = PlanarSteps.between(np.cos(heading), np.sin(heading), c * x + s * y, c * y - s * x)
        return DriftPath(None, self.odometry.stamps, steps.sums())

    def _headings_and_places(self, turn_scale: float, turn_bias: float, slip: float) -> tuple[Floats, Floats]:
        """Return by how much (N,), rad, the errors turn each pose, and the places (3, N), m, seen from the first pose.

        The scale is not in the places, because it only multiplies them.
        """

        def compute() -> tuple[Floats, Floats]:
            more = turn_scale * self._turned + turn_bias * self._seconds
            middle = (more[1:] + more[:-1]) / 2  # The chord of an arc points along the mean of the two headings at its ends.
            cos, sin = np.cos(middle), np.sin(middle)
            x, y, z = self._ways if slip == 0 else self._ways * gripping(slip, self._curvature)
            places = np.zeros((3, len(more)))
            places[0, 1:], places[1, 1:], places[2, 1:] = cos * x - sin * y, sin * x + cos * y, z
            return more, np.cumsum(places, axis=1, out=places)

        return self._moved.get((turn_scale, turn_bias, slip), compute)


def gripping(slip: float, curvature: Floats) -> Floats:
    """Return the ratio (...) of the true length of steps to the length in the odometry, from 0 to 2.

    slip: m by which a length is too long for each radian of turning. curvature: (...) rad/m of the path, positive.
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

        said, corrected: the path so far, as the robot sent it and after the correction. None at the start of a path.
        """
        self._scale, self._turn_scale, self._turn_bias, self._slip = (error.get(name, 0.0) for name in ODOMETRY)
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
        if self._scale == self._turn_scale == self._turn_bias == self._slip == 0:
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
        middle = self._turned + more / 2  # as in `CorrectablePath`
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

        The curvature is of the last `_CURVE` seconds, because the steps to come are unknown.
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


def corrected_mount(base_T_camera: Floats, error: Mapping[str, float], name: str) -> Floats:
    """Return poses base_T_camera (..., 4, 4), turned about the axes of base and moved along them by the errors of a camera.

    name: the name of the camera. error: the turns (rad) and the moves (m) by name.
    """
    turn = _turn(*(float(error.get(f"{name}.{axis}", 0.0)) for axis in AXES))
    move = np.array([error.get(f"{name}.{axis}", 0.0) for axis in "xyz"])
    return make_pose(turn @ base_T_camera[..., :3, :3], base_T_camera[..., :3, 3] + move)


@lru_cache(maxsize=64)
def _turn(roll: float, tilt: float, yaw: float) -> Floats:
    """Return the rotation (3, 3) by the errors `AXES`. Derivatives by other errors need the same rotation many times."""
    turn = rotation_from_vector(np.array([roll, tilt, yaw]))
    turn.setflags(write=False)  # All callers get this array.
    return turn


def lens_errors(error: Mapping[str, float], name: str) -> tuple[float, float, float]:
    """Return the errors `LENS` of the camera with this name."""
    focal, cx, cy = (error.get(f"{name}.{one}", 0.0) for one in LENS)
    return focal, cx, cy


def inverse_lens(errors: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the errors `LENS` whose correction undoes the correction of the given errors."""
    longer = 1 + errors[0]
    return 1 / longer - 1, -errors[1] / longer, -errors[2] / longer


def refocused(directions: Floats, errors: Floats | tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return unit directions (..., R, 3), corrected by the errors `LENS` of a camera matrix, and their factors (..., R).

    The factors are on the standard deviations of the directions. The correction is a linear map M and a projection onto the
    unit sphere. It multiplies areas on the sphere by det M / |M d|^3 at direction d, and standard deviations by the root.
    Towards the edge of an image, angles change by less than in its middle. With one factor for all directions, noise at the
    edge would favour a shorter focal length.

    directions: (R, 3) unit. errors: (..., R, 3) of each direction, or (3,) of all.
    """
    (focal, cx, cy), (x, y, z) = np.moveaxis(np.asarray(errors), -1, 0), directions.T
    longer = np.stack([x - cx * z, y - cy * z, (1 + focal) * z], axis=-1)
    length = lengths(longer)
    return longer / length[..., None], np.sqrt((1 + focal) / length) / length


def later(stamps: Floats, clock: float, path: Trajectory | None) -> Floats:
    """Return stamps (N,), s, plus an offset `clock`, s. A stamp that was on the path stays on it, and the order stays.

    Stamps that the offset moves beyond an end of the path are squeezed into the millisecond inside that end, where they have
    nearly the pose of the end. All streams of a camera move alike, so an image keeps the stamp of its boxes. Without a path,
    the offset is only added.
    """
    moved = stamps + clock
    if clock == 0 or path is None:
        return moved
    begin, end = float(path.stamps[0]), float(path.stamps[-1])
    squeezed = min(_SQUEEZED, (end - begin) / 2)
    if clock > 0:
        rest, beyond = end - squeezed, moved > end - squeezed
        inside = rest + squeezed * (moved - rest) / (squeezed + clock)
    else:
        rest, beyond = begin + squeezed, moved < begin + squeezed
        inside = rest - squeezed * (rest - moved) / (squeezed - clock)
    on_path = (stamps >= begin) & (stamps <= end)
    return np.where(on_path & beyond, np.clip(inside, begin, end), moved)


def corrected_camera(one: CameraLog, error: Mapping[str, float], path: Trajectory | None = None) -> CameraLog:
    """Return a camera and its data, corrected by the errors. path: the path on which its stamps stay (see `later`)."""
    camera, name = one.camera, one.camera.name
    clock, (focal, cx, cy) = error.get(f"{name}.clock", 0.0), lens_errors(error, name)
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    longer = 1 + error.get("range_scale", 0.0)
    corrected = replace(
        camera,
        base_T_camera=corrected_mount(camera.base_T_camera, error, name),
        matrix=camera.matrix + np.array([[focal * fx, 0, cx * fx], [0, focal * fy, cy * fy], [0, 0, 0]]),
        depth_scale=camera.depth_scale / longer,
    )

    def moved(images: Images | None) -> Images | None:
        return None if images is None else replace(images, stamps=later(images.stamps, clock, path))

    found = one.detections
    if found is not None:
        depths = corrected_ranges(error, found.depths, _AHEAD, np.array(longer))
        found = replace(found, frame_stamps=later(found.frame_stamps, clock, path), depths=depths)
    mount = None if one.mount is None else Trajectory(one.mount.stamps, corrected_mount(one.mount.poses, error, name))
    return CameraLog(corrected, found, moved(one.rgb), moved(one.depth), mount)


def _place_of(pose: Floats) -> tuple[float, float, float]:
    x, y, z = pose[:3, 3].tolist()
    return x, y, z
