"""Compute the residuals of boxes against bodies, and the derivatives of the residuals.

Let a plane go through the camera centre m, with the outward unit normal n. Let a body have the centre c and the support
h(n). The plane touches the body if n . (c - m) + h(n) = 0. For an ellipsoid with the matrix M, h = sqrt(n^T M n), and this
is the equation of its dual quadric (Hartley and Zisserman 2004, section 8.3). If the left side is not 0, it is the length,
m, by which the body reaches beyond the plane. Divided by the distance of the touched point, it is an angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.edges import BoxEdges, by_columns
from objslam.triangulation.bodies.shapes import PARAMETERS, Kind, rows_of_kinds

ROWS = 5
"""The number of residuals of a box: two of its shift and two of half its size, px, and one of its range, m."""
_LEAST = 1e-9
"""The least length (m) of a divisor. A larger length distorts small bodies."""
_ALONG = np.linspace(0.125, 1.0, 8)[:, None]
"""The places of the points that are tried on a straight side of a body, as shares of the length of the side. With more
points, the place where a box touches the side in a distorted image is more exact. With 8 points, the error is below 0.1 px
for a side that is 60 degrees long."""


@dataclass(frozen=True)
class Residuals:
    """The residuals of B boxes.

    value: (B, 5), predicted minus measured: the shift in x and y (px), half of the width and of the height (px), and the
    range (m). If an edge of an axis is a bound, the residuals of the two edges of this axis replace its shift and its size.
    by: (B, 5, 7) the derivatives of `value` by the parameters of the bodies. rows: (B, 5, 8) the derivatives, followed by
    the value. use: (B, 5) whether a residual counts, 0 to 1. An edge that is a bound counts only while the body does not
    reach beyond it. A range counts only if its ray hits the body.
    """

    rows: Floats
    use: Floats

    @property
    def value(self) -> Floats:
        return self.rows[..., PARAMETERS]

    @property
    def by(self) -> Floats:
        return self.rows[..., :PARAMETERS]

    def take(self, boxes: Bools | Ints) -> Residuals:
        """Select boxes by a mask or by indices."""
        return Residuals(by_columns(self.rows, boxes), by_columns(self.use, boxes))

    def put(self, boxes: Bools | Ints, new: Residuals) -> None:
        """Overwrite the residuals of some boxes."""
        self.rows[boxes], self.use[boxes] = new.rows, new.use


def edge_gaps(edges: BoxEdges, values: Floats, kind: Kind) -> tuple[Floats, Floats, Floats]:
    """Return the gaps (B, 4), m, by which bodies (N, 7) reach beyond the planes of edges.

    Also return the derivatives (B, 4, 7) of the gaps by the parameters, and the points (B, 4, 3), m, in map at which the
    bodies come closest to the planes.
    """
    gap, by_shape, points = _gaps(edges, values, kind)
    return gap, np.concatenate([edges.normal, by_shape], axis=2), points


def _gaps(edges: BoxEdges, values: Floats, kind: Kind) -> tuple[Floats, Floats, Floats]:
    """Return the same as `edge_gaps`, but only the derivatives (B, 4, 4) by the last four parameters.

    The derivatives by the centre are the normals.
    """
    centre = by_columns(values[:, :3], edges.body)
    reach, by_shape, points = kind.support(values, edges.body, edges.normal)
    points += centre[:, None]
    return _products(edges.normal, (centre - edges.origin)[:, None]) + reach, by_shape, points


def residuals(edges: BoxEdges, values: Floats, kind: Kind) -> Residuals:
    """Return the residuals of bodies (N, 7) of one kind. The derivatives treat the distance to touched points as fixed."""
    gap, by_gap, points = _gaps(edges, values, kind)
    half = 0.5 / _scale(edges, points)
    rows, use = np.empty((len(gap), ROWS, PARAMETERS + 1), order="F"), np.ones((len(gap), ROWS), order="F")
    row, axis = _axes_with_bound(edges)
    # A column of all boxes at a time stays in the cache of the processor.
    for number, column in enumerate([*edges.normal.T, *by_gap.T, gap.T]):
        low, high = (column * half.T).reshape(2, 2, -1)  # Half of the rows of single edges.
        np.subtract(high, low, out=rows.T[number, :2])
        np.add(high, low, out=rows.T[number, 2:4])
        rows[row, axis, number], rows[row, axis + 2, number] = 2 * low[axis, row], 2 * high[axis, row]
    for place in (axis, axis + 2):
        use[row, place] = 1.0 - edges.bound[row, place] * (gap[row, place] > 0)
    rows[:, 4], use[:, 4] = 0.0, 0.0
    known = np.flatnonzero(np.isfinite(edges.range))
    if len(known):
        distance, rows[known, 4, :PARAMETERS], hit = kind.ranges(
            values[edges.body[known]], edges.origin[known], edges.direction[known]
        )
        rows[known, 4, PARAMETERS] = np.where(hit, distance - edges.range[known], 0.0)
        use[known, 4] = hit
    return Residuals(rows, use)


def beyond_edges(edges: BoxEdges, values: Floats, kind: Kind) -> Floats:
    """Return how far (B, 4), px, bodies (N, 7) of one kind reach beyond each edge."""
    gap, _, points = _gaps(edges, values, kind)
    return gap / _scale(edges, points)


def _scale(edges: BoxEdges, points: Floats) -> Floats:
    """Return the length (B, 4), m, of one pixel at the distance of points (B, 4, 3), m, of the bodies."""
    away = points - edges.origin[:, None]
    return np.maximum(np.sqrt(_products(away, away)) * edges.turn, _LEAST)


def _products(one: Floats, other: Floats) -> Floats:
    """Return the scalar products (B, 4) of vectors (B, 4, 3) with vectors (B, 4, 3) or (B, 1, 3)."""
    return np.asarray(one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1] + one[..., 2] * other[..., 2])


def residuals_of_shapes(edges: BoxEdges, values: Floats, shape: Ints) -> Residuals:
    """Return the residuals of bodies (N, 7) with shapes (N,), indices of `core.bodies.body.SHAPES`."""
    count = len(edges)
    found = Residuals(np.empty((count, ROWS, PARAMETERS + 1)), np.empty((count, ROWS)))
    for kind, boxes in rows_of_kinds(shape[edges.body]):
        found.put(boxes, residuals(edges.take(boxes), values, kind))
    return found


def touched_points(edges: BoxEdges, values: Floats, shape: Ints) -> Floats:
    """Return points (B, 4, P, 3), m, in map at which the edges may touch bodies (N, 7) with shapes (N,).

    The first is the point of the body closest to the plane. The others lie on the straight sides that end at this point.
    """
    points = np.empty((len(edges), 4, 1 + 3 * len(_ALONG), 3))
    for kind, boxes in rows_of_kinds(shape[edges.body]):
        some = edges.take(boxes)
        nearest, centre = _gaps(some, values, kind)[2][:, :, None], values[some.body, None, :3]
        points[boxes] = nearest
        along = kind.sides(values[some.body, None], nearest[:, :, 0] - centre)
        more = (nearest[..., None, :] + _ALONG * along[..., None, :]).reshape(len(some), 4, -1, 3)
        points[boxes, :, 1 : 1 + more.shape[2]] = more
    return points


def nominal_noise(edges: BoxEdges) -> Floats:
    """Return the standard deviations (B, 5) of shift (px), half size (px) and range (m), as the settings say."""
    edge = edges.sigma / np.sqrt(2)
    sigma = np.empty((len(edge), ROWS))
    sigma[:, :2], sigma[:, 2:4] = np.hypot(edge, edges.shift)[:, None], edge[:, None]
    sigma[:, 4] = np.where(np.isfinite(edges.range), edges.range_sigma, 1.0)
    return sigma


def at_edges(edges: BoxEdges, noise: Floats) -> Floats:
    """Return the noise (B, 5) of the residuals, given the noise (B, 5) of shift, size and range.

    If an edge of an axis is a bound, the residuals of this axis are those of its two edges. The noise of an edge is the root
    of the summed squares of the noise of shift and of size.
    """
    row, axis = _axes_with_bound(edges)
    both = np.hypot(noise[row, axis], noise[row, axis + 2])
    noise = noise.copy()
    noise[row, axis] = noise[row, axis + 2] = both
    return noise


def on_shift_and_size(edges: BoxEdges, rows: Floats) -> Floats:
    """Return derivatives (B, 5, ...) by shift, size and range, from derivatives `rows` (B, 5, ...) by the residuals.

    If an edge of an axis is a bound, the residuals of this axis are those of its two edges. A shift changes these two
    residuals with opposite signs. A size changes both with the same sign.
    """
    row, axis = _axes_with_bound(edges)
    low, high = rows[row, axis], rows[row, axis + 2]
    rows = rows.copy()
    rows[row, axis], rows[row, axis + 2] = high - low, high + low
    return rows


def whole_axes(edges: BoxEdges) -> Bools:
    """Return a mask (B, 4) of the residuals of boxes that are shifts and sizes. These are the residuals of axes without a
    bound."""
    return np.tile((edges.bound[:, :2] == 0) & (edges.bound[:, 2:] == 0), 2)


def _axes_with_bound(edges: BoxEdges) -> tuple[Ints, Ints]:
    row, axis = np.nonzero((edges.bound[:, :2] > 0) | (edges.bound[:, 2:] > 0))
    return row, axis
