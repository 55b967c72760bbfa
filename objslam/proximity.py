"""The proximity field: Eq. 1's cost around one object, the heat map of Staszak & Belter's Fig. 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.triangulation import solve_eq1
from objslam.types import Bools, Floats

_BLOCK = 2_000_000  # distances held at a time
_WIDE, _MOST, _LEAST = 8.0, 3.0, 0.15
"""Half of a slice is as many times the rays' median distance to the minimum, but no more and no less than so many metres."""


@dataclass(frozen=True)
class Slice:
    """A plane of the field. points: (n, n, 3) m in map; cost: (n, n) m, the rays' mean distance to each point."""

    points: Floats
    cost: Floats


@dataclass(frozen=True)
class Field:
    """The field of one object.

    minimum: (3,) m, where Eq. 1 puts the object, and cost: m, the rays' mean distance there. horizontal: the slice through
    it in parallel to the floor; vertical: the one along the rays' mean direction, in which the object is least certain.
    """

    minimum: Floats
    cost: float
    horizontal: Slice
    vertical: Slice


def proximity(origins: Floats, directions: Floats, points: Floats) -> Floats:
    """Eq. 1's cost over the number of rays, m, at points (..., 3): the mean distance to rays (R, 3), (R, 3) unit, R > 0."""
    flat = points.reshape(-1, 3)
    centre = flat.mean(axis=0)  # squares of large map coordinates would leave no digits for small distances
    p, m = flat - centre, origins - centre
    foot = m - np.einsum("ri,ri->r", m, directions)[:, None] * directions
    cost = np.empty(len(flat))
    step = max(1, _BLOCK // len(origins))
    for begin in range(0, len(flat), step):
        some = p[begin : begin + step]
        # |p - foot|^2 without the part along the ray
        squared = (some**2).sum(axis=1)[:, None] - 2 * some @ foot.T + (foot**2).sum(axis=1) - (some @ directions.T) ** 2
        cost[begin : begin + step] = np.sqrt(np.maximum(squared, 0.0)).mean(axis=1)
    return cost.reshape(points.shape[:-1])


def field(origins: Floats, directions: Floats, size: int = 101, reach: float | None = None) -> Field:
    """The field of the object that rays (R, 3), (R, 3) unit, R >= 2, point to, in slices of size x size points.

    reach: half the edge of a slice, m; None: as wide as the rays pass the object. Parallel rays have no minimum: then the
    slices lie 1 m ahead, as `solve_eq1` has it.
    """
    count = np.zeros(len(origins), dtype=np.int64)
    minimum = solve_eq1(origins, directions, count, 1)[0][0]
    off = np.linalg.norm(np.cross(minimum - origins, directions), axis=1)
    if reach is None:
        reach = float(np.clip(_WIDE * np.median(off), _LEAST, _MOST))
    side = reach * np.linspace(-1.0, 1.0, size)
    east, north, up = np.eye(3)
    ahead = level(directions)
    horizontal = minimum + side[None, :, None] * east + side[:, None, None] * north
    vertical = minimum + side[None, :, None] * ahead + side[:, None, None] * up
    return Field(
        minimum=minimum,
        cost=float(off.mean()),
        horizontal=Slice(horizontal, proximity(origins, directions, horizontal)),
        vertical=Slice(vertical, proximity(origins, directions, vertical)),
    )


def level(directions: Floats) -> Floats:
    """The horizontal unit direction (3,) that rays with directions (R, 3) mostly lie along, as lines; east where none is."""
    flat = directions[:, :2]
    values, axes = np.linalg.eigh(flat.T @ flat)
    if values[1] < 1e-12:
        return np.array([1.0, 0.0, 0.0])
    return np.array([*axes[:, 1], 0.0])


def pulling(weight: Floats, object_: Bools) -> Bools:
    """Which rays (R,) pull on an object: those of it (R,) bool that no robust loss rejected, all where none is left."""
    kept = object_ & (weight > 0)
    return kept if kept.any() else object_
