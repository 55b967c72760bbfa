"""The first look at a map: where the eye stands, and where the labels go so that none covers another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.label_layout import place_labels
from objslam.scene import frame_objects
from objslam.types import Bools, Floats, ObjectMap

_FOV = np.radians(55.0)  # the viewer's own, from the lower to the upper edge
_VIEW = np.array([900.0, 620.0])  # px of the map's view in a window of 1600 x 900
_MARGIN = 0.86  # share of the view that the map fills
_FROM = np.array([-0.28, -0.80, 0.78])  # the south, a little to the west, half from above
_LETTER, _PADDING, _LINE = 7.3, 12.0, 24.0  # px of a label: a letter, both its sides, its height


@dataclass(frozen=True)
class Eye:
    """position, target: (3,) m in map. axes: (3, 3), rows right, up and towards the target. focal: px."""

    position: Floats
    target: Floats
    axes: Floats
    focal: float

    def see(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2), x right, y down, of points (N, 3), and their depths (N,) m."""
        x, y, depth = ((points - self.position) @ self.axes.T).T
        safe = np.maximum(depth, 1e-6)
        return np.column_stack([x, -y]) * self.focal / safe[:, None] + _VIEW / 2, depth

    def has_in_view(self, points: Floats) -> Bools:
        """Which points (N, 3) are seen."""
        pixels, depth = self.see(points)
        return ((pixels >= 0) & (pixels <= _VIEW)).all(axis=1) & (depth > 0)

    def offset(self, pixels: Floats, depth: Floats) -> Floats:
        """How far in map (N, 3), in the plane of the view at a depth (N,), so many pixels (N, 2) are."""
        return (pixels * [1.0, -1.0] * depth[:, None] / self.focal) @ self.axes[:2]


def first_eye(objects: ObjectMap, path: Floats) -> Eye:
    """An eye from which the objects and the path (K, 3) fill the view, far away ones left out."""
    positions = np.array([o.position for o in objects.objects]).reshape(-1, 3)
    inside, low, high = frame_objects(positions, path)
    points = np.concatenate([positions[inside], path[((path >= low) & (path <= high)).all(axis=1)], [low, high]])
    centre = (low + high) / 2
    axes = _axes(_FROM)
    tangent = _MARGIN * np.tan(_FOV / 2) * np.array([_VIEW[0] / _VIEW[1], 1.0])
    for _ in range(4):  # the middle of what is seen is not that of the box: perspective makes the near half larger
        x, y, ahead = ((points - centre) @ axes.T).T
        distance = max(float(np.max(np.abs(x) / tangent[0] - ahead)), float(np.max(np.abs(y) / tangent[1] - ahead)), 1.0)
        seen = np.column_stack([x, y]) / np.maximum(distance + ahead, 1e-6)[:, None]
        shift = (seen.min(axis=0) + seen.max(axis=0)) / 2 * distance
        centre = centre + shift @ axes[:2]
    return look_at(centre, _FROM, distance)


def look_at(target: Floats, back: Floats, distance: float) -> Eye:
    """An eye that looks at a target (3,) from a direction (3,) and a distance, m."""
    axes = _axes(back)
    return Eye(target - distance * axes[2], target, axes, _VIEW[1] / 2 / np.tan(_FOV / 2))


def _axes(back: Floats) -> Floats:
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), -back])


def label_places(eye: Eye, anchors: Floats, texts: list[str], avoid: Floats) -> tuple[Floats, Floats]:
    """Where labels hang (N, 3), and where the lines to them end (N, 3), so that from the eye none covers another or a dot.

    anchors: (N, 3) the objects, as far away as their labels will be; avoid: (P, 3), better not covered. The viewer hangs a
    label below its place. Labels that find no room hang straight below their object.
    """
    if len(anchors) == 0:
        return anchors, anchors
    dots, depth = eye.see(anchors)
    crowd, ahead = eye.see(avoid)
    sizes = np.column_stack([np.array([len(text) for text in texts]) * _LETTER + _PADDING, np.full(len(texts), _LINE)])
    corners, found = place_labels(dots, sizes, np.stack([np.zeros(2), _VIEW]), crowd[ahead > 0])
    corners = np.where((found & (depth > 0))[:, None], corners, dots - [0.5, 0.0] * sizes)
    hung = corners + [0.5, 0.0] * sizes
    near = np.clip(dots, corners, corners + sizes)
    return anchors + eye.offset(hung - dots, depth), anchors + eye.offset(near - dots, depth)
