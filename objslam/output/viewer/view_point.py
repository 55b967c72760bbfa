"""Choose the first view of a map, and place labels on the map and in camera images."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.object_map import ObjectMap
from objslam.core.types import Up
from objslam.frontend.up import from_above, up_vector
from objslam.output.plot.label_layout import place_labels
from objslam.output.plot.style import frame_objects

_FOV = np.radians(55.0)  # The vertical field of view of the viewer, rad.
_VIEW = np.array([900.0, 620.0])  # The width and height of the view of the map, px, in a window of 1600 x 900.
_FILLED = 0.86  # The share of the view that the map fills.
_FROM = np.array([-0.28, -0.80, 0.78])  # The direction of the first view point from the map: -y, slightly -x, 43 deg up.
_LINE = 24.0  # The height of a label on the map, px.
_LETTER, _PADDING = 7.3, 12.0  # The width of a letter, and the sum of both margins of a label, px on the screen.
_IMAGE_LINE = 21.0  # The height of a label in an image, px on the screen.
_IMAGE_VIEW = (580.0, 350.0)  # The width and height of the view of a camera, px, in a window of 1600 x 900.
_ROWS = 6  # The number of rows below a dot in which its label may be.


@dataclass(frozen=True)
class ViewPoint:
    """A view point with its camera axes and focal length."""

    position: Floats  # (3,) m in map.
    target: Floats  # (3,) m in map, at the centre of the view.
    axes: Floats  # (3, 3), the rows point right, up and towards the target.
    focal: float  # The focal length, px.
    up: Floats  # (3,) the unit vector in map that points up in the world.

    @property
    def distance(self) -> float:
        """Return the distance from the view point to its target, m."""
        return float(np.linalg.norm(self.position - self.target))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Project points (N, 3), m in map. Return their pixels (N, 2), x right and y down, and their depths (N,), m."""
        x, y, depth = ((points - self.position) @ self.axes.T).T
        safe = np.maximum(depth, 1e-6)
        return np.column_stack([x, -y]) * self.focal / safe[:, None] + _VIEW / 2, depth

    def has_in_view(self, points: Floats) -> Bools:
        """Return a mask (N,) of the points (N, 3), m in map, that lie in the view."""
        pixels, depth = self.project(points)
        return ((pixels >= 0) & (pixels <= _VIEW)).all(axis=1) & (depth > 0)

    def offset(self, pixels: Floats, depth: Floats) -> Floats:
        """Convert offsets in the view (N, 2), px, at depths (N,), m, to offsets (N, 3), m in map."""
        return (pixels * [1.0, -1.0] * depth[:, None] / self.focal) @ self.axes[:2]


def first_view_point(objects: ObjectMap, path: Floats, up: Up = "z") -> ViewPoint:
    """Return the view point from which the objects and the path (K, 3), m, fill the view. Far objects are ignored.

    up: the axis of the map that points up.
    """
    positions = np.array([o.position for o in objects.objects]).reshape(-1, 3)
    inside, low, high = frame_objects(positions, path)
    points = np.concatenate([positions[inside], path[((path >= low) & (path <= high)).all(axis=1)], [low, high]])
    centre = (low + high) / 2
    back = _FROM @ np.stack([*np.eye(3)[from_above(up)], up_vector(up)])
    axes = _axes(back, up_vector(up))
    tangent = _FILLED * np.tan(_FOV / 2) * np.array([_VIEW[0] / _VIEW[1], 1.0])
    for _ in range(4):  # Perspective enlarges the near half of the map, so the target moves to the centre in steps.
        x, y, ahead = ((points - centre) @ axes.T).T
        distance = max(float(np.max(np.abs(x) / tangent[0] - ahead)), float(np.max(np.abs(y) / tangent[1] - ahead)), 1.0)
        seen = np.column_stack([x, y]) / np.maximum(distance + ahead, 1e-6)[:, None]
        shift = (seen.min(axis=0) + seen.max(axis=0)) / 2 * distance
        centre = centre + shift @ axes[:2]
    return look_at(centre, back, distance, up)


def look_at(target: Floats, back: Floats, distance: float, up: Up = "z") -> ViewPoint:
    """Return the view point at a distance, m, from a target (3,), m in map.

    back: (3,) the direction from the target to the view point. up: the axis of the map that points up.
    """
    axes = _axes(back, up_vector(up))
    return ViewPoint(target - distance * axes[2], target, axes, _VIEW[1] / 2 / np.tan(_FOV / 2), up_vector(up))


def _axes(back: Floats, up: Floats) -> Floats:
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), -back])


def label_places(view_point: ViewPoint, anchors: Floats, texts: list[str], avoid: Floats) -> tuple[Floats, Floats]:
    """Place labels so that, from the view point, no label covers another label or a dot.

    A label without a free place hangs below its object.

    Args:
        anchors: (N, 3) the objects, m in map. A label has the depth of its object.
        avoid: (P, 3) points, m in map, that the labels should not cover.
    Returns:
        The centres (N, 3) of the labels' upper edges, and the points (N, 3) at which leader lines meet the labels, m in map.
    """
    if len(anchors) == 0:
        return anchors, anchors
    dots, depth = view_point.project(anchors)
    crowd, ahead = view_point.project(avoid)
    sizes = np.column_stack([np.array([len(text) for text in texts]) * _LETTER + _PADDING, np.full(len(texts), _LINE)])
    corners, found = place_labels(dots, sizes, np.stack([np.zeros(2), _VIEW]), crowd[ahead > 0])
    corners = np.where((found & (depth > 0))[:, None], corners, dots - [0.5, 0.0] * sizes)
    hung = corners + [0.5, 0.0] * sizes
    near = np.clip(dots, corners, corners + sizes)
    return anchors + view_point.offset(hung - dots, depth), anchors + view_point.offset(near - dots, depth)


def label_rows(frame: Ints, dots: Floats, letters: Ints, size: tuple[float, float]) -> tuple[Floats, Bools]:
    """Place labels in rows of their images, from left to right. Each label gets the first free row below its dot.

    Args:
        frame: (S,) the image of each dot.
        dots: (S, 2) px of the image.
        letters: (S,) the number of letters of each label.
        size: width and height of the images, px. The viewer scales an image to its view.
    Returns:
        The positions (S, 2) of the labels, px of the image, and a mask (S,) of the labels that were placed.
    """
    scale = min(_IMAGE_VIEW[0] / size[0], _IMAGE_VIEW[1] / size[1])  # px on the screen per px of the image
    half = (letters * _LETTER + _PADDING) / 2 / scale
    line = _IMAGE_LINE / scale
    order = np.lexsort((dots[:, 0] - half, frame))
    first = np.searchsorted(frame[order], frame[order])
    rank = np.arange(len(order)) - first
    row = np.ceil(dots[:, 1] / line).astype(np.int64)
    frames = int(frame.max()) + 1 if len(frame) else 0
    until = np.full((frames, int(np.ceil(size[1] / line)) + _ROWS + 1), -np.inf)  # Labels fill each row up to this x, px.
    hung, found = dots.copy(), np.zeros(len(dots), dtype=bool)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        mine = order[rank == k]  # The k-th label of each image.
        for below in range(_ROWS):
            at = row[mine] + below
            free = until[frame[mine], at] <= dots[mine, 0] - half[mine]
            take = mine[free]
            until[frame[take], at[free]] = dots[take, 0] + half[take]
            hung[take, 1] = at[free] * line
            found[take] = True
            mine = mine[~free]
    return hung, found
