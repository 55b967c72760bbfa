"""All hypotheses about wrong input."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Log
from objslam.mapping.checks.hypotheses.hypothesis import Hypothesis, with_cameras
from objslam.mapping.checks.hypotheses.mounts import mounts, w_last

_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 1.5, 2.0, 3.0, 4.0)
"""The tried sizes of the images in which the boxes were found, as multiples of the image size in the calibration. More sizes
take longer."""
_SQUARES = (320, 416, 512, 640)
"""The sides (px) of square images that detectors often use. More sides take longer."""
_CLIPPED, _AT_EDGE = 0.05, 1.0
"""The least share of boxes that end at an edge of the image, and the distance (px) from the edge that counts as the edge. A
detector clips boxes at the right and the lower edge of the image. If at least this share of the boxes ends at an edge, and
hardly any box ends beyond the edge, the boxes are in px of the calibration's images. In another unit, boxes end there only
by chance. With a larger share, more wrong sizes are tried. With a larger distance, fewer are tried."""
_CLOCK = np.concatenate([-np.arange(0.5, 6.1, 0.5), np.arange(0.5, 6.1, 0.5)])
"""The tried clock offsets (s). `small_errors` finds smaller offsets."""


def hypotheses(log: Log) -> Iterator[Hypothesis]:
    """Yield each hypothesis that applies to a log."""
    yield from coarse_hypotheses(log)
    edges = _clipped_edges(log)
    if not edges:
        yield from _boxes(any(one.camera.sees_size for one in log.cameras))
    yield from _squares(edges)
    yield from _clocks()


def coarse_hypotheses(log: Log) -> Iterator[Hypothesis]:
    """Yield the hypotheses about mounts, paths and images. Each wrong hypothesis of this kind moves most rays by far."""
    yield from mounts(log)
    yield from _paths(log)
    yield from _images()


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


def _clipped_edges(log: Log) -> set[int]:
    """Return the widths and heights (px) of the cameras' images at whose right or lower edges boxes end.

    Boxes end there only if they are in px of these images, or of images with the same width or height.
    """
    found: set[int] = set()
    for one in log.cameras:
        if one.detections is not None and len(one.detections):
            beyond = one.detections.boxes[:, 2:] - one.camera.size
            at, past = (np.abs(beyond) <= _AT_EDGE).mean(axis=0), (beyond > _AT_EDGE).mean(axis=0)
            found |= set(one.camera.size[(at >= _CLIPPED) & (past < at / 2)].astype(int).tolist())
    return found


def _boxed(change: Callable[[Floats, Camera], Floats]) -> Callable[[Log], Log]:
    def put_right(log: Log) -> Log:
        return with_cameras(log, lambda one: _with_boxes(one, change))

    return put_right


def _images() -> Iterator[Hypothesis]:
    """Yield the hypotheses that boxes are mirrored, turned by 180 degrees, or have x and y swapped."""
    what, cause = "the boxes mirrored", "the images were mirrored before detection"
    yield Hypothesis("image mirrored", what, cause, _boxed(_mirrored))
    what, cause = "the boxes turned by 180 degrees", "the camera or its images are upside down"
    yield Hypothesis("image upside down", what, cause, _boxed(_upside_down))
    what, cause = "boxes read as y1 x1 y2 x2", "x and y of the boxes are swapped"
    yield Hypothesis("boxes yxyx", what, cause, _boxed(lambda b, c: b[:, [1, 0, 3, 2]]))


def _boxes(sized: bool) -> Iterator[Hypothesis]:
    """Yield the hypotheses about the unit and the order of boxes. sized: whether the boxes have a size. If not, the
    hypotheses about width and height are left out."""
    known: tuple[tuple[str, str, str, Callable[[Floats, Camera], Floats]], ...] = (
        ("boxes xywh", "boxes read as x y width height", "the boxes are x y width height, not x1 y1 x2 y2", _xywh),
        ("boxes cxcywh", "boxes read as centre, width, height", "the boxes are centre, width, height", _cxcywh),
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
            yield Hypothesis(name, what, cause, _boxed(change))
    for size in _SIZES:
        cause = f"the boxes belong to images {size:.3g} times as large as the calibration says"
        change = partial(_divided, size=size)
        yield Hypothesis(f"boxes of size {size:.3g}", f"the boxes divided by {size:.3g}", cause, _boxed(change))


def _squares(edges: set[int]) -> Iterator[Hypothesis]:
    """Yield the hypotheses that the boxes are in px of the square image that a detector gets.

    edges: px, the widths and heights at which boxes end, from `_clipped_edges`. A square is left out if boxes end at the
    edge of another size.
    """
    for side in _SQUARES:
        if edges - {side}:
            continue
        what, cause = f"the boxes stretched from {side} x {side} px to the image", f"the detector's square of {side} px"
        yield Hypothesis(
            f"boxes of a square of {side}", what, f"the boxes are in px of {cause}", _boxed(partial(_stretched, side=side))
        )


def _clocks() -> Iterator[Hypothesis]:
    for offset in _CLOCK.tolist():
        sign = "later" if offset > 0 else "earlier"
        yield Hypothesis(
            f"clock {offset:+.1f} s",
            f"the stamps of the frames {abs(offset):g} s {sign}",
            f"the clock of the camera is about {abs(offset):g} s {'behind' if offset > 0 else 'ahead of'} the poses",
            partial(later, offset=offset),
            clock=offset,
        )


def with_frame_stamps(log: Log, change: Callable[[Floats], Floats]) -> Log:
    """Return the log with the stamps (F,) of the frames of each camera changed."""

    def changed(one: CameraLog) -> CameraLog:
        found = one.detections
        return one if found is None else replace(one, detections=replace(found, frame_stamps=change(found.frame_stamps)))

    return with_cameras(log, changed)


def with_poses(log: Log, change: Callable[[Floats], Floats]) -> Log:
    """Return the log with the poses (N, 4, 4) of its odometry and its localisation changed."""

    def changed(path: Trajectory | None) -> Trajectory | None:
        return None if path is None else Trajectory(path.stamps, change(path.poses))

    return replace(log, odometry=changed(log.odometry), localization=changed(log.localization))


def with_headings(log: Log, degrees: float) -> Log:
    """Return the log with all headings turned by an angle, as if the cameras were turned on the robot."""
    turn = lift_se2(np.array([0.0, 0.0, np.radians(degrees)]))
    return with_poses(log, lambda poses: poses @ turn)


def later(log: Log, offset: float) -> Log:
    """Return the log with the stamps of all frames later by an offset (s)."""
    return with_frame_stamps(log, lambda stamps: stamps + offset)


def yaws(poses: Floats) -> Floats:
    """Return the unwrapped headings (N,), rad."""
    return np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def _yaw_times(poses: Floats, factor: float) -> Floats:
    """Return poses with their headings multiplied by a factor."""
    return make_pose(_about_z(factor * yaws(poses)), poses[:, :3, 3])


def _from_degrees(poses: Floats) -> Floats:
    """Return corrected poses whose headings (degrees) were taken for radians.

    A rotation matrix keeps a heading modulo 2 pi, so multiples of 6.3 degrees are lost here. Two assumptions restore them: a
    robot turns evenly, and it drives in the direction of its heading.
    """
    said = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    steps = np.unwrap(np.append(0.0, np.diff(said)))  # Each step is near the previous one.
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


def _with_boxes(one: CameraLog, change: Callable[[Floats, Camera], Floats]) -> CameraLog:
    found = one.detections
    return one if found is None else replace(one, detections=replace(found, boxes=change(found.boxes, one.camera)))
