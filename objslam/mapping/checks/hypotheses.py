"""Hypotheses about wrong input. Each is a change that would correct the log."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.rotation import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from objslam.core.types import CameraLog, Log, Trajectory

_OPTICAL = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""The pose of an optical frame (x right, y down, z forward) in a body frame (x forward, y left, z up)."""
_SIDES = {"ahead": 0, "to the left": 90, "back": 180, "to the right": -90}
"""The usual directions of a camera (degrees)."""
_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 1.5, 2.0, 3.0, 4.0)
"""The tried sizes of the images in which the boxes were found, as multiples of the image size in the calibration."""
_SQUARES = (320, 416, 512, 640)
"""The sides (px) of square images that detectors often use."""
_CLOCK = np.concatenate([-np.arange(0.5, 6.1, 0.5), np.arange(0.5, 6.1, 0.5)])
"""The tried clock offsets (s). `small_errors` finds smaller offsets."""


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault of the input. name: short and fixed. what: a description of the corrected log. cause: the probable
    mistake. put_right: returns the corrected log."""

    name: str
    what: str
    cause: str
    put_right: Callable[[Log], Log]


def hypotheses(log: Log) -> Iterator[Hypothesis]:
    """Yield each hypothesis that applies to a log."""
    yield from _mounts(log)
    yield from _paths(log)
    yield from _boxes(any(one.camera.sees_size for one in log.cameras))
    yield from _clocks()


def _mounts(log: Log) -> Iterator[Hypothesis]:
    if all(one.mount is not None for one in log.cameras):
        return

    def mounted(change: Callable[[Floats], Floats]) -> Callable[[Log], Log]:
        return lambda log: _with_cameras(
            log, lambda one: replace(one, camera=replace(one.camera, base_T_camera=change(one.camera.base_T_camera)))
        )

    cause = "base_T_camera is probably camera_T_base"
    yield Hypothesis("mount inverted", "base_T_camera inverted", cause, mounted(inverse))
    if all(np.allclose(one.camera.base_T_camera[:3, :3], np.eye(3), atol=1e-3) for one in log.cameras):
        for side, degrees in _SIDES.items():
            turn = make_pose(rotation_from_vector(np.array([0.0, 0.0, np.radians(degrees)])), np.zeros(3))
            yield Hypothesis(
                f"mount unset, {side}",
                f"a camera that looks {side}",
                "base_T_camera is not set, or its axes are those of a body and not of an optical frame",
                mounted(partial(_mounted, turn=turn)),
            )
        return
    cause = "base_T_camera probably has the axes of a body (x forward) instead of those of an optical frame (z forward)"
    yield Hypothesis("mount axes", "the axes of an optical frame in base_T_camera", cause, mounted(lambda p: p @ _OPTICAL))
    cause = "the quaternion of base_T_camera is probably w x y z instead of x y z w"
    yield Hypothesis("mount wxyz", "the quaternion of base_T_camera read as w x y z", cause, mounted(w_last))


def _paths(log: Log) -> Iterator[Hypothesis]:
    known: tuple[tuple[str, str, str, Callable[[Floats], Floats]], ...] = (
        ("poses wxyz", "quaternions of the poses read as w x y z", "the poses have w first instead of last", w_last),
        ("poses inverted", "the poses inverted", "the poses are base_T_map instead of map_T_base", inverse),
        ("poses xy swapped", "x and y of the poses swapped", "x and y of the poses are swapped", _swapped),
        ("poses y negated", "y of the poses negated", "the poses have their y to the right instead of the left", _y_negated),
        ("poses x negated", "x of the poses negated", "the poses have their x backwards", _x_negated),
        ("yaw negated", "the yaw of the poses negated", "the yaw of the poses is clockwise", lambda p: _yaw_times(p, -1.0)),
        (
            "yaw in degrees",
            "the yaw of the poses divided by 57.3",
            "the yaw of the poses is in degrees instead of rad",
            _from_degrees,
        ),
    )
    path = log.localization or log.odometry
    if path is None:
        return
    for name, what, cause, change in known:
        yield Hypothesis(name, what, cause, partial(with_poses, change=change))


def _boxes(sized: bool) -> Iterator[Hypothesis]:
    """Yield the hypotheses about boxes. sized: whether the boxes have a size. Without it, the hypotheses about width and
    height are left out."""

    def boxed(change: Callable[[Floats, Camera], Floats]) -> Callable[[Log], Log]:
        def put_right(log: Log) -> Log:
            return _with_cameras(log, lambda one: _with_boxes(one, change))

        return put_right

    known: tuple[tuple[str, str, str, Callable[[Floats, Camera], Floats]], ...] = (
        ("image mirrored", "the boxes mirrored", "the images were mirrored before detection", _mirrored),
        ("image upside down", "the boxes turned by 180 degrees", "the camera or its images are upside down", _upside_down),
        ("boxes xywh", "boxes read as x y width height", "the boxes are x y width height, not x1 y1 x2 y2", _xywh),
        ("boxes cxcywh", "boxes read as centre, width, height", "the boxes are centre, width, height", _cxcywh),
        ("boxes yxyx", "boxes read as y1 x1 y2 x2", "x and y of the boxes are swapped", lambda b, c: b[:, [1, 0, 3, 2]]),
        ("boxes 0..1", "boxes times the image size", "the boxes are shares of the image, not px", _from_shares),
        (
            "boxes 0..1 cxcywh",
            "boxes read as shares of the image: centre, width, height",
            "the boxes are shares of the image (centre, width, height), not px",
            lambda b, c: _cxcywh(_from_shares(b, c), c),
        ),
    )
    for name, what, cause, change in known:
        if sized or change not in (_xywh, _cxcywh):
            yield Hypothesis(name, what, cause, boxed(change))
    for size in _SIZES:
        cause = f"the boxes belong to images {size:.3g} times as large as the calibration says"
        change = partial(_divided, size=size)
        yield Hypothesis(f"boxes of size {size:.3g}", f"the boxes divided by {size:.3g}", cause, boxed(change))
    for side in _SQUARES:
        what, cause = f"the boxes stretched from {side} x {side} px to the image", f"the detector's square of {side} px"
        yield Hypothesis(
            f"boxes of a square of {side}", what, f"the boxes are in px of {cause}", boxed(partial(_stretched, side=side))
        )


def _clocks() -> Iterator[Hypothesis]:
    for offset in _CLOCK.tolist():
        sign = "later" if offset > 0 else "earlier"
        yield Hypothesis(
            f"clock {offset:+.1f} s",
            f"the stamps of the frames {abs(offset):g} s {sign}",
            f"the clock of the camera is about {abs(offset):g} s {'behind' if offset > 0 else 'ahead of'} that of the poses",
            partial(later, offset=offset),
        )


def with_frame_stamps(log: Log, change: Callable[[Floats], Floats]) -> Log:
    """Return the log with the stamps (F,) of the frames of each camera changed."""

    def changed(one: CameraLog) -> CameraLog:
        found = one.detections
        return one if found is None else replace(one, detections=replace(found, frame_stamps=change(found.frame_stamps)))

    return _with_cameras(log, changed)


def with_poses(log: Log, change: Callable[[Floats], Floats]) -> Log:
    """Return the log with the poses (N, 4, 4) of its odometry and its localisation changed."""

    def changed(path: Trajectory | None) -> Trajectory | None:
        return None if path is None else Trajectory(path.stamps, change(path.poses))

    return replace(log, odometry=changed(log.odometry), localization=changed(log.localization))


def later(log: Log, offset: float) -> Log:
    """Return the log with the stamps of all frames later by an offset (s)."""
    return with_frame_stamps(log, lambda stamps: stamps + offset)


def _mounted(pose: Floats, turn: Floats) -> Floats:
    return pose @ turn @ _OPTICAL


def w_last(poses: Floats) -> Floats:
    """Correct poses (..., 4, 4) whose quaternions were stored with w first, but were read with w last."""
    read = quaternion_from_rotation(poses[..., :3, :3])
    return make_pose(rotation_from_quaternion(np.roll(read, -1, axis=-1)), poses[..., :3, 3])


def yaws(poses: Floats) -> Floats:
    """Return the unwrapped headings (N,), rad."""
    return np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def _yaw_times(poses: Floats, factor: float) -> Floats:
    """Return poses with their headings multiplied by a factor."""
    return make_pose(_about_z(factor * yaws(poses)), poses[:, :3, 3])


def _from_degrees(poses: Floats) -> Floats:
    """Correct poses whose headings (degrees) were taken for radians.

    A rotation matrix keeps a heading modulo 2 pi, so multiples of 6.3 degrees are lost here. Two assumptions restore them: a
    robot turns evenly, and it drives in the direction of its heading.
    """
    said = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    steps = np.unwrap(np.append(0.0, np.diff(said)))  # Each step is near the step before.
    yaw = np.radians(np.cumsum(steps))
    way = np.diff(poses[:, :2, 3], axis=0) @ [1, 1j] * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    return make_pose(_about_z(yaw + np.angle(way.sum())), poses[:, :3, 3])


def _about_z(yaw: Floats) -> Floats:
    """Return the rotations (N, 3, 3) with headings (N,), rad."""
    return lift_se2(np.column_stack([np.zeros((len(yaw), 2)), yaw]))[:, :3, :3]


def _swapped(poses: Floats) -> Floats:
    return make_pose(poses[:, :3, :3], poses[:, [1, 0, 2], 3])


def _y_negated(poses: Floats) -> Floats:
    return make_pose(poses[:, :3, :3], poses[:, :3, 3] * [1, -1, 1])


def _x_negated(poses: Floats) -> Floats:
    return make_pose(poses[:, :3, :3], poses[:, :3, 3] * [-1, 1, 1])


def _mirrored(boxes: Floats, camera: Camera) -> Floats:
    last = camera.width - 1
    return np.stack([last - boxes[:, 2], boxes[:, 1], last - boxes[:, 0], boxes[:, 3]], axis=1)


def _upside_down(boxes: Floats, camera: Camera) -> Floats:
    return np.asarray((np.tile(camera.size - 1, 2) - boxes)[:, [2, 3, 0, 1]])


def _xywh(boxes: Floats, camera: Camera) -> Floats:
    return np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)


def _cxcywh(boxes: Floats, camera: Camera) -> Floats:
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)


def _divided(boxes: Floats, camera: Camera, size: float) -> Floats:
    return boxes / size


def _stretched(boxes: Floats, camera: Camera, side: float) -> Floats:
    return boxes * np.tile(camera.size, 2) / side


def _from_shares(boxes: Floats, camera: Camera) -> Floats:
    return boxes * np.tile(camera.size, 2)


def _with_cameras(log: Log, change: Callable[[CameraLog], CameraLog]) -> Log:
    return replace(log, cameras=tuple(change(one) for one in log.cameras))


def _with_boxes(one: CameraLog, change: Callable[[Floats, Camera], Floats]) -> CameraLog:
    found = one.detections
    return one if found is None else replace(one, detections=replace(found, boxes=change(found.boxes, one.camera)))
