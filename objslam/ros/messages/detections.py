"""Read boxes from detection messages: vision_msgs in four layouts and AprilTags of several packages."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera, in_field, project
from objslam.core.geometry import pose_from_quaternion
from objslam.core.types import MAX_BOXES as MAX_BOXES
from objslam.ros.messages.topic_types import DETECTIONS

WRONG_LAYOUT = (AttributeError, TypeError, LookupError, ValueError)
"""The errors that `find_boxes` raises for a message whose fields have another layout."""
_UNKNOWN = [math.nan] * 4


class Found(NamedTuple):
    """One detection."""

    box: list[float]  # x1, y1, x2, y2, px, or NaN if only `points` is known.
    label: str  # The label may be empty.
    score: float
    track: str = ""  # The track name may be empty.
    points: Floats | None = None  # Centre and corners (5, 3) of a tag, m, in the camera frame. None if `box` is known.
    corners: list[list[float]] | None = None  # The four corners x, y of a tag, px, in the order of the message.


def find_boxes(type_: str, message: Any) -> Iterator[Found]:
    """Yield the detections of a message whose type satisfies `is_boxes`."""
    return vision_boxes(message) if type_ == DETECTIONS else tag_boxes(message)


def track_number(name: str, tracks: dict[str, int]) -> int:
    """Return the track id of a track name. If the name has only digits, the id is this number. Any other name gets a new id,
    which is stored in `tracks`. The empty name has the id -1."""
    if not name:
        return -1
    if name.isascii() and name.isdigit() and len(name) < 18:
        return int(name)
    return tracks.setdefault(name, 10**18 + len(tracks))


def boxes_of_points(camera: Camera, points: Floats) -> Floats:
    """Return the boxes (M, 4) of tags, x1, y1, x2, y2 in px of the raw image. The centre of a tag is the centre of its box.

    points: (M, 5, 3) the centre and the corners of each tag in the camera frame, m. If a point is outside the field of the
    lens, the box is NaN.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = project(camera, points.reshape(-1, 3)).reshape(-1, 5, 2)
    reach = np.abs(pixels[:, 1:] - pixels[:, :1]).max(axis=1)
    boxes = np.concatenate([pixels[:, 0] - reach, pixels[:, 0] + reach], axis=1)
    boxes[~in_field(camera, points.reshape(-1, 3)).reshape(-1, 5).all(axis=1)] = np.nan
    return np.asarray(boxes)


def vision_boxes(message: Any) -> Iterator[Found]:
    """Yield the detections of a vision_msgs/Detection2DArray. Each detection has the label and score of its best hypothesis.
    A rotated box is replaced by the upright box around it."""
    for detection in message.detections:
        centre, label, score = detection.bbox.center, "", 0.0
        width, height, turn = detection.bbox.size_x, detection.bbox.size_y, centre.theta
        if turn and math.isfinite(turn):
            cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
            width, height = width * cos + height * sin, width * sin + height * cos
        place = getattr(centre, "position", centre)
        for result in detection.results:
            hypothesis = getattr(result, "hypothesis", result)
            if not label or hypothesis.score > score:
                score = float(hypothesis.score)
                label = str(hypothesis.class_id if hasattr(hypothesis, "class_id") else hypothesis.id)
        if hasattr(detection, "is_tracking"):
            track = detection.tracking_id if detection.is_tracking else ""
        else:
            track = getattr(detection, "id", "")
        x, y, across, down = (float(value) for value in (place.x, place.y, width / 2, height / 2))
        yield Found([x - across, y - down, x + across, y + down], label, score, str(track))


def tag_boxes(message: Any) -> Iterator[Found]:
    """Yield the tags of an AprilTag array message with label tag_<id> and score 1.

    The box centre is the intersection of the tag diagonals. The box is symmetric about this centre and contains all corners.
    A message of apriltag_ros has poses instead of corners, so its tags get `points` instead of a box. Tag bundles in such a
    message are skipped, because a bundle is not a single object.
    """
    for tag in message.apriltags if hasattr(message, "apriltags") else message.detections:
        if hasattr(tag, "corners"):
            corners = _corners(tag.corners)
            yield Found(_box_around(corners), f"tag_{int(tag.id)}", 1.0, corners=corners)
        elif len(tag.id) == 1:
            yield Found(_UNKNOWN, f"tag_{int(tag.id[0])}", 1.0, points=_tag_points(tag.pose.pose.pose, float(tag.size[0])))


def _corners(corners: Any) -> list[list[float]]:
    if hasattr(corners[0], "x"):
        return [[float(corner.x), float(corner.y)] for corner in corners]
    return [[float(corners[i]), float(corners[i + 1])] for i in range(0, 8, 2)]


def _box_around(corners: list[list[float]]) -> list[float]:
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    ux, uy, vx, vy = cx - ax, cy - ay, dx - bx, dy - by
    cross = ux * vy - uy * vx
    if not cross or not math.isfinite(cross):
        return _UNKNOWN
    share = ((bx - ax) * vy - (by - ay) * vx) / cross
    x, y = ax + share * ux, ay + share * uy
    width, height = max(abs(px - x) for px, _ in corners), max(abs(py - y) for _, py in corners)
    return [x - width, y - height, x + width, y + height]


def _tag_points(pose: Any, size: float) -> Floats:
    place, turn = pose.position, pose.orientation
    xyzw = np.array([[turn.x, turn.y, turn.z, turn.w]])
    if not np.linalg.norm(xyzw) > 0:
        return np.full((5, 3), np.nan)
    camera_T_tag = pose_from_quaternion(np.array([[place.x, place.y, place.z]]), xyzw)[0]
    square = np.array([[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
    return np.asarray(square @ camera_T_tag[:3, :2].T + camera_T_tag[:3, 3])
