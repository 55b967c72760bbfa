"""Compare the bodies of a map object and of a true object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.bodies.upright_box import overlap
from objslam.core.object_map import MapObject
from objslam.core.types import TruthObject
from objslam.evaluation.alignment import Transform

_SQUARE = 1.1
"""The least ratio of true length to true width of an object whose heading is compared. With a larger ratio, fewer headings
are compared."""


@dataclass(frozen=True)
class BodyMatch:
    """The errors of a body compared with the true body, after the alignment.

    size_error: (3,) errors of length, width and height, as shares of the true sizes. yaw_error: rad, in [0, pi/2]. It is
    None if the true object is about square or has no yaw. iou: the intersection over union of the upright boxes around the
    two bodies, because a true object has no shape. It is None without a true yaw.
    """

    size_error: Floats
    yaw_error: float | None
    iou: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the values for evaluation.json, with the yaw in degrees."""
        yaw = None if self.yaw_error is None else float(np.degrees(self.yaw_error))
        return {"size_error": self.size_error.tolist(), "yaw_error_deg": yaw, "iou": self.iou}


def match_bodies(found: MapObject, true: TruthObject, transform: Transform) -> BodyMatch | None:
    """Return the errors of the body of a map object, or None if the map object has no body or the true object no size."""
    if found.body is None or true.size is None:
        return None
    size = found.body.size * transform.scale
    error = size / true.size - 1
    if true.yaw is None:
        return BodyMatch(error, None, None)
    turned = transform.pose[:3, :3] @ np.array([np.cos(found.body.yaw), np.sin(found.body.yaw), 0.0])
    yaw = float(np.arctan2(turned[1], turned[0]))
    off = abs((yaw - true.yaw + np.pi / 2) % np.pi - np.pi / 2)
    place = transform.apply(found.position[None])[0]
    iou = overlap((place, size, yaw), (true.position, true.size, true.yaw))
    return BodyMatch(error, off if true.size[0] > _SQUARE * true.size[1] else None, iou)


def body_scores(matches: list[BodyMatch]) -> dict[str, float | int | None]:
    """Return the number of compared bodies, and the medians of the size error, the yaw error (degrees) and the IoU."""
    sizes = [np.abs(m.size_error).mean() for m in matches]
    yaws = [np.degrees(m.yaw_error) for m in matches if m.yaw_error is not None]
    overlaps = [m.iou for m in matches if m.iou is not None]
    return {
        "bodies": len(matches),
        "size_error_median": _median(sizes),
        "yaw_error_deg_median": _median(yaws),
        "iou_median": _median(overlaps),
    }


def _median(values: list[Any]) -> float | None:
    return float(np.median(values)) if values else None
