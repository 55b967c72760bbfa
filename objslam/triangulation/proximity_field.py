"""Compute the proximity field of an object: the cost of Eq. 1 around it, as in the heat map of Staszak & Belter, Fig. 2."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.triangulation.triangulate import solve_eq1

_AT_ONCE = 2_000_000  # The most distances computed together. A larger value needs more memory.
_REACH = 8.0  # Half the edge of a slice, as a multiple of the rays' median distance from the minimum.
_LEAST_REACH, _MOST_REACH = 0.15, 3.0  # The least and the largest half edge (m) of a slice.


@dataclass(frozen=True)
class FieldSlice:
    """A square grid of points in a plane of the field.

    points: (n, n, 3) m in map. cost: (n, n) m, the mean distance of the rays from each point.
    """

    points: Floats
    cost: Floats


@dataclass(frozen=True)
class ProximityField:
    """The field of one object.

    minimum: (3,) m in map, the solution of Eq. 1. cost: m, the mean distance of the rays from the minimum. horizontal: the
    slice through the minimum, parallel to the floor. vertical: the upright slice through the minimum, along the mean
    direction of the rays. The object is the least certain in this direction.
    """

    minimum: Floats
    cost: float
    horizontal: FieldSlice
    vertical: FieldSlice


def proximity(origins: Floats, directions: Floats, points: Floats) -> Floats:
    """Return the mean distances (...), m, of points (..., 3), m, from R > 0 rays. This is the cost of Eq. 1 divided by R.

    origins: (R, 3) m. directions: (R, 3) unit.
    """
    flat = points.reshape(-1, 3)
    centre = flat.mean(axis=0)  # Squares of large map coordinates would hide small distances.
    p, m = flat - centre, origins - centre
    foot = m - np.einsum("ri,ri->r", m, directions)[:, None] * directions
    cost = np.empty(len(flat))
    step = max(1, _AT_ONCE // len(origins))
    for begin in range(0, len(flat), step):
        some = p[begin : begin + step]
        # This is |p - foot|^2 without the part along the ray.
        squared = (some**2).sum(axis=1)[:, None] - 2 * some @ foot.T + (foot**2).sum(axis=1) - (some @ directions.T) ** 2
        cost[begin : begin + step] = np.sqrt(np.maximum(squared, 0.0)).mean(axis=1)
    return cost.reshape(points.shape[:-1])


def proximity_field(origins: Floats, directions: Floats, size: int = 101, reach: float | None = None) -> ProximityField:
    """Return the field of one object with R >= 2 rays. A slice has `size` x `size` points.

    origins: (R, 3) m. directions: (R, 3) unit. reach: half the edge of a slice, m. If it is None, the distances of the rays
    give it. Parallel rays have no minimum. Their slices lie 1 m ahead, at the point of `solve_eq1`.
    """
    minimum = solve_eq1(origins, directions, np.zeros(len(origins), dtype=np.int64), 1)[0][0]
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
    """Return the mean horizontal unit direction (3,) of undirected rays (R, 3). It is east if all rays are vertical."""
    flat = directions[:, :2]
    values, axes = np.linalg.eigh(flat.T @ flat)
    return np.array([1.0, 0.0, 0.0] if values[1] < 1e-12 else [*axes[:, 1], 0.0])


def supporting_rays(weight: Floats, object_: Bools) -> Bools:
    """Return a mask (R,) of the rays of an object with a weight (R,) above 0. If no ray has one, return all its rays.

    object_: (R,) the mask of the rays of the object.
    """
    kept = object_ & (weight > 0)
    return kept if kept.any() else object_
