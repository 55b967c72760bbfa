"""Find the points near a place or in a box with a k-d tree, which does not look at every point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from objslam.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_SLACK = 1e-9
"""How much farther than asked the tree looks: this length (m), and this share of the radius. Then the exact distances
decide. A larger value covers more rounding, and asks for more points."""


class SpatialIndex:
    """N points (N, 3), m. Points that are not finite are never found. A place has two or three coordinates: with x and y
    alone, heights do not count."""

    def __init__(self, points: Floats) -> None:
        self.points = points
        self.finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        self._trees: dict[int, KDTree] = {}

    def _tree(self, coordinates: int) -> KDTree:
        """Return the tree of the first two or of all three coordinates. It is made at the first query."""
        from scipy.spatial import KDTree  # Deferred, because a map is often read without any query.

        if coordinates not in self._trees:
            self._trees[coordinates] = KDTree(self.points[self.finite, :coordinates])
        return self._trees[coordinates]

    def nearest(self, place: Floats) -> int | None:
        """Return the index of the point nearest to a place, or of the first of several such points. None if there are no
        points."""
        if not len(self.finite):
            return None
        distance, _ = self._tree(len(place)).query(place)
        return int(self.within(place, _wider(float(distance)))[0])

    def within(self, place: Floats, radius: float) -> Ints:
        """Return the indices of all points at most `radius` m from a place, the nearest first."""
        if not len(self.finite) or not radius >= 0:
            return np.zeros(0, dtype=np.int64)
        near = self._near(place, radius, 2.0) if np.isfinite(radius) else self.finite
        distance = np.linalg.norm(self.points[near, : len(place)] - place, axis=1)
        order = np.argsort(distance, kind="stable")
        return np.asarray(near[order[distance[order] <= radius]])

    def inside(self, low: Floats, high: Floats) -> Ints:
        """Return the indices of all points inside or on the box with the opposite corners `low` and `high`, in order."""
        if not len(self.finite) or (high < low).any():
            return np.zeros(0, dtype=np.int64)
        side = (high - low)[:2].max()
        near = self._near(((low + high) / 2)[:2], side / 2, np.inf) if np.isfinite(side) else self.finite
        some = self.points[near, : len(low)]
        return np.asarray(near[((some >= low) & (some <= high)).all(axis=1)])

    def _near(self, place: Floats, radius: float, norm: float) -> Ints:
        """Return all points at most `radius` m from a place, and a few that are slightly farther, in order. norm: 2 or
        infinity."""
        found = self._tree(len(place)).query_ball_point(place, _wider(radius), p=norm)
        return self.finite[np.sort(np.asarray(found, dtype=np.int64))]


def _wider(radius: float) -> float:
    return radius + _SLACK * (1 + radius)


def place_of(values: ArrayLike) -> Floats:
    """Return a place as an array of its two or three coordinates. ValueError if they are not finite numbers."""
    place = _coordinates(values)
    if not np.isfinite(place).all():
        raise ValueError(f"a point must be finite, got {values!r}")
    return place


def corners_of(low: ArrayLike, high: ArrayLike) -> tuple[Floats, Floats]:
    """Return the corners of a box as arrays. A corner may be at infinity. ValueError if the two are no opposite corners of
    one box."""
    lower, upper = _coordinates(low), _coordinates(high)
    if lower.shape != upper.shape:
        raise ValueError("both corners must have two coordinates, or both three")
    if (lower > upper).any():
        raise ValueError(f"the corner `low` must not lie above the corner `high`, got {lower.tolist()} and {upper.tolist()}")
    return lower, upper


def _coordinates(values: ArrayLike) -> Floats:
    point = np.asarray(values, dtype=np.float64)
    if point.shape not in ((2,), (3,)) or np.isnan(point).any():
        raise ValueError(f"a point is x, y or x, y, z in metres, got {values!r}")
    return point
