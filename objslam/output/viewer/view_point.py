"""The first view of a map: where it is seen from, and where the labels hang so that none covers another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.object_map import ObjectMap
from objslam.output.plot.label_layout import place_labels
from objslam.output.plot.style import frame_objects
from objslam.output.viewer.image_labels import LETTER, PADDING

_FOV = np.radians(55.0)  # The viewer's own field of view, rad, from the lower to the upper edge.
_VIEW = np.array([900.0, 620.0])  # Width and height, px, of the map's view in a window of 1600 x 900.
_FILLED = 0.86  # The share of the view that the map fills.
_FROM = np.array([-0.28, -0.80, 0.78])  # The direction of the first view: from the south, a little west, half from above.
_LINE = 24.0  # The height, px, of a label on the map.


@dataclass(frozen=True)
class ViewPoint:
    """Where the map is seen from."""

    position: Floats  # (3,) m in map.
    target: Floats  # (3,) m in map, the middle of the view.
    axes: Floats  # (3, 3), rows right, up and towards the target.
    focal: float  # px.

    @property
    def distance(self) -> float:
        """From the view point to its target, m."""
        return float(np.linalg.norm(self.position - self.target))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2), x right, y down, of points (N, 3), and their depths (N,) m."""
        x, y, depth = ((points - self.position) @ self.axes.T).T
        safe = np.maximum(depth, 1e-6)
        return np.column_stack([x, -y]) * self.focal / safe[:, None] + _VIEW / 2, depth

    def has_in_view(self, points: Floats) -> Bools:
        """Which points (N, 3) are in the view."""
        pixels, depth = self.project(points)
        return ((pixels >= 0) & (pixels <= _VIEW)).all(axis=1) & (depth > 0)

    def offset(self, pixels: Floats, depth: Floats) -> Floats:
        """The distance (N, 3), m in map, that pixels (N, 2) span in the plane of the view at depths (N,), m."""
        return (pixels * [1.0, -1.0] * depth[:, None] / self.focal) @ self.axes[:2]


def first_view_point(objects: ObjectMap, path: Floats) -> ViewPoint:
    """The view point from which the objects and the path (K, 3) fill the view; objects far away are left out."""
    positions = np.array([o.position for o in objects.objects]).reshape(-1, 3)
    inside, low, high = frame_objects(positions, path)
    points = np.concatenate([positions[inside], path[((path >= low) & (path <= high)).all(axis=1)], [low, high]])
    centre = (low + high) / 2
    axes = _axes(_FROM)
    tangent = _FILLED * np.tan(_FOV / 2) * np.array([_VIEW[0] / _VIEW[1], 1.0])
    for _ in range(4):  # perspective makes the near half larger, so the middle of the view is found step by step
        x, y, ahead = ((points - centre) @ axes.T).T
        distance = max(float(np.max(np.abs(x) / tangent[0] - ahead)), float(np.max(np.abs(y) / tangent[1] - ahead)), 1.0)
        seen = np.column_stack([x, y]) / np.maximum(distance + ahead, 1e-6)[:, None]
        shift = (seen.min(axis=0) + seen.max(axis=0)) / 2 * distance
        centre = centre + shift @ axes[:2]
    return look_at(centre, _FROM, distance)


def look_at(target: Floats, back: Floats, distance: float) -> ViewPoint:
    """The view point at a distance, m, from a target (3,), in a direction (3,)."""
    axes = _axes(back)
    return ViewPoint(target - distance * axes[2], target, axes, _VIEW[1] / 2 / np.tan(_FOV / 2))


def _axes(back: Floats) -> Floats:
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), -back])


def label_places(view_point: ViewPoint, anchors: Floats, texts: list[str], avoid: Floats) -> tuple[Floats, Floats]:
    """Hang labels so that from the view point none covers another or a dot.

    A label without room hangs straight below its object.

    Args:
        anchors: (N, 3) m in map, the objects; a label is as far away as its object.
        avoid: (P, 3) points that are better not covered.
    Returns:
        Where labels hang (N, 3), the middle of their upper edges, and where the lines to them end (N, 3); m in map.
    """
    if len(anchors) == 0:
        return anchors, anchors
    dots, depth = view_point.project(anchors)
    crowd, ahead = view_point.project(avoid)
    sizes = np.column_stack([np.array([len(text) for text in texts]) * LETTER + PADDING, np.full(len(texts), _LINE)])
    corners, found = place_labels(dots, sizes, np.stack([np.zeros(2), _VIEW]), crowd[ahead > 0])
    corners = np.where((found & (depth > 0))[:, None], corners, dots - [0.5, 0.0] * sizes)
    hung = corners + [0.5, 0.0] * sizes
    near = np.clip(dots, corners, corners + sizes)
    return anchors + view_point.offset(hung - dots, depth), anchors + view_point.offset(near - dots, depth)
