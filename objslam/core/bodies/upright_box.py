"""The overlap of upright boxes."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats

UprightBox = tuple[Floats, Floats, float]
"""An upright box: its centre (3,), m, its length, width and height (3,), m, and the yaw of its length, rad."""


def overlap(first: UprightBox, second: UprightBox) -> float:
    """Return the intersection over union, 0 to 1, of two upright boxes.

    The two rectangles seen from above are intersected as polygons (Sutherland and Hodgman 1974).
    """
    (centre, size, _), (from_, size_, _) = first, second
    height = min(centre[2] + size[2] / 2, from_[2] + size_[2] / 2) - max(centre[2] - size[2] / 2, from_[2] - size_[2] / 2)
    if height <= 0:
        return 0.0
    polygon, frame = footprint(first), footprint(second)
    for begin, end in zip(frame, np.roll(frame, -1, axis=0), strict=True):
        polygon = _clipped(polygon, begin, end - begin)
        if len(polygon) < 3:
            return 0.0
    x, y = polygon.T
    shared = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 * height
    return float(shared / (size.prod() + size_.prod() - shared))


def footprint(box: UprightBox) -> Floats:
    """Return the corners (4, 2), m, of an upright box seen from above, counter-clockwise."""
    centre, size, yaw = box
    cos, sin = np.cos(yaw), np.sin(yaw)
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return np.asarray(centre[:2] + signs * size[:2] / 2 @ np.array([[cos, sin], [-sin, cos]]))


def _clipped(polygon: Floats, begin: Floats, along: Floats) -> Floats:
    """Return the part of a polygon (n, 2) to the left of the line through `begin` (2,) in the direction `along` (2,)."""
    side = along[0] * (polygon[:, 1] - begin[1]) - along[1] * (polygon[:, 0] - begin[0])
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if side[i] >= 0:
            kept.append(polygon[i])
        if (side[i] >= 0) != (side[j] >= 0):
            kept.append(polygon[i] + side[i] / (side[i] - side[j]) * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 2)
