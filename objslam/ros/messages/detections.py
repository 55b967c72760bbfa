"""Boxes out of detection messages: vision_msgs in its four layouts, and AprilTags in those of several packages."""

from __future__ import annotations

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
"""What `find_boxes` raises for a message that is not laid out as its type says."""

_UNKNOWN = [math.nan] * 4


class Found(NamedTuple):
    """One detection: box x1, y1, x2, y2 in px, label ("" without one), score, and the tracker's name for it ("" likewise).

    points: (5, 3) m in the camera frame, the centre and the corners of a tag of which the message gives only the pose; the
    box is then not yet known.
    """

    box: list[float]
    label: str
    score: float
    track: str = ""
    points: Floats | None = None


def find_boxes(type_: str, message: Any) -> Iterator[Found]:
    """The detections of a message of a type that `is_boxes`."""
    return vision_boxes(message) if type_ == DETECTIONS else tag_boxes(message)


def track_number(name: str, tracks: dict[str, int]) -> int:
    """A tracker's name for an object as a number: -1 for none, its own number if it is one, else a new one for each name."""
    if not name:
        return -1
    if name.isascii() and name.isdigit() and len(name) < 18:
        return int(name)
    return tracks.setdefault(name, 10**18 + len(tracks))


def boxes_of_points(camera: Camera, points: Floats) -> Floats:
    """Boxes (M, 4), px of the raw image, around tags (M, 5, 3) seen by the camera, centred on the image of the centre.

    NaN where a tag is not in the field of the camera's lens.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = project(camera, points.reshape(-1, 3)).reshape(-1, 5, 2)
    reach = np.abs(pixels[:, 1:] - pixels[:, :1]).max(axis=1)
    boxes = np.concatenate([pixels[:, 0] - reach, pixels[:, 0] + reach], axis=1)
    boxes[~in_field(camera, points.reshape(-1, 3)).reshape(-1, 5).all(axis=1)] = np.nan
    return np.asarray(boxes)


def vision_boxes(message: Any) -> Iterator[Found]:
    """The detections of a vision_msgs/Detection2DArray: of several hypotheses the best, of a turned box its bounds."""
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
        box = [place.x - width / 2, place.y - height / 2, place.x + width / 2, place.y + height / 2]
        yield Found(box, label, score, str(track))


def tag_boxes(message: Any) -> Iterator[Found]:
    """The tags of an array message of AprilTags, labelled tag_<id>, with score 1.

    The centre of a box is where the diagonals of the tag meet, as the centre of a square does in every picture of it; the
    box reaches out to the furthest corner. Bundles of tags (apriltag_ros), which are no single thing, give nothing.
    """
    for tag in message.apriltags if hasattr(message, "apriltags") else message.detections:
        if hasattr(tag, "corners"):
            box = _box_around(_corners(tag.corners))
            yield Found(box, f"tag_{int(tag.id)}", 1.0)
        elif len(tag.id) == 1:
            yield Found(_UNKNOWN, f"tag_{int(tag.id[0])}", 1.0, points=_tag_points(tag.pose.pose.pose, float(tag.size[0])))


def _corners(corners: Any) -> list[tuple[float, float]]:
    if hasattr(corners[0], "x"):
        return [(corner.x, corner.y) for corner in corners]
    return [(float(corners[i]), float(corners[i + 1])) for i in range(0, 8, 2)]


def _box_around(corners: list[tuple[float, float]]) -> list[float]:
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
