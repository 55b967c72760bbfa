"""The proximity field: Eq. 1's cost around one object, the heat map of Staszak & Belter's Fig. 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.triangulation.triangulate import solve_eq1

_AT_ONCE = 2_000_000  # The distances computed together; larger needs more memory.
_REACH = 8.0  # Half the edge of a slice, as a multiple of the rays' median distance from the minimum.
_LEAST_REACH, _MOST_REACH = 0.15, 3.0  # The least and the greatest half edge of a slice, m.


@dataclass(frozen=True)
class FieldSlice:
    """A plane of the field. points: (n, n, 3) m in map; cost: (n, n) m, the rays' mean distance to each point."""

    points: Floats
    cost: Floats


@dataclass(frozen=True)
class ProximityField:
    """The field of one object.

    minimum: (3,) m, Eq. 1's solution, and cost: m, the rays' mean distance there. horizontal: the slice through it parallel
    to the floor. vertical: the slice along the rays' mean direction, in which the object is least certain.
    """

    minimum: Floats
    cost: float
    horizontal: FieldSlice
    vertical: FieldSlice


def proximity(origins: Floats, directions: Floats, points: Floats) -> Floats:
    """The mean distance, m, of points (..., 3) from rays (R, 3), (R, 3) unit, R > 0: Eq. 1's cost over R."""
    flat = points.reshape(-1, 3)
    centre = flat.mean(axis=0)  # squares of large map coordinates would leave no digits for small distances
    p, m = flat - centre, origins - centre
    foot = m - np.einsum("ri,ri->r", m, directions)[:, None] * directions
    cost = np.empty(len(flat))
    step = max(1, _AT_ONCE // len(origins))
    for begin in range(0, len(flat), step):
        some = p[begin : begin + step]
        # |p - foot|^2 without the part along the ray
        squared = (some**2).sum(axis=1)[:, None] - 2 * some @ foot.T + (foot**2).sum(axis=1) - (some @ directions.T) ** 2
        cost[begin : begin + step] = np.sqrt(np.maximum(squared, 0.0)).mean(axis=1)
    return cost.reshape(points.shape[:-1])


def proximity_field(origins: Floats, directions: Floats, size: int = 101, reach: float | None = None) -> ProximityField:
    """The field of the object to which rays (R, 3), (R, 3) unit, R >= 2, point, in slices of size x size points.

    reach: half the edge of a slice, m; None takes it from how far the rays pass the object. Parallel rays have no minimum:
    then the slices lie 1 m ahead, as in `solve_eq1`.
    """
    count = np.zeros(len(origins), dtype=np.int64)
    minimum = solve_eq1(origins, directions, count, 1)[0][0]
    off = np.linalg.norm(np.cross(minimum - origins, directions), axis=1)
    if reach is None:
        reach = float(np.clip(_REACH * np.median(off), _LEAST_REACH, _MOST_REACH))
    side = reach * np.linspace(-1.0, 1.0, size)
    east, north, up = np.eye(3)
    ahead = main_heading(directions)
    horizontal = minimum + side[None, :, None] * east + side[:, None, None] * north
    vertical = minimum + side[None, :, None] * ahead + side[:, None, None] * up
    return ProximityField(
        minimum=minimum,
        cost=float(off.mean()),
        horizontal=FieldSlice(horizontal, proximity(origins, directions, horizontal)),
        vertical=FieldSlice(vertical, proximity(origins, directions, vertical)),
    )


def main_heading(directions: Floats) -> Floats:
    """The horizontal unit direction (3,) along which rays with directions (R, 3), as lines, mostly lie; else east."""
    flat = directions[:, :2]
    values, axes = np.linalg.eigh(flat.T @ flat)
    if values[1] < 1e-12:
        return np.array([1.0, 0.0, 0.0])
    return np.array([*axes[:, 1], 0.0])


def supporting_rays(weight: Floats, object_: Bools) -> Bools:
    """Which rays (R,) of an object (R,) bool pull on it: those that no robust loss rejected, or all if it rejected all."""
    kept = object_ & (weight > 0)
    return kept if kept.any() else object_
