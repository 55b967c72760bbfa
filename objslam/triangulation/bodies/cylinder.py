"""Upright cylinders with an elliptic section, by the seven parameters of an ellipsoid (see `ellipsoid`).

The section of the cylinder is the horizontal section of this ellipsoid. Half the height of the cylinder is the half axis
upwards of the ellipsoid.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.ellipsoid import axes_jacobian, forms, half_axes, heading, matrices, section, touched

__all__ = ["axes_jacobian", "half_axes", "heading", "ranges", "support"]

_LEAST = 1e-9
"""The least length (m) of a divisor. A larger length distorts small bodies."""
_FLAT = 1e-12
"""The least squared or vertical component of a ray in a divisor, without a unit. It prevents a division by zero. A larger
value distorts rays that are nearly parallel to a face."""


def support(values: Floats, body: Ints, normals: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the support of cylinders (see `shapes.Kind`): the support of the section plus that of the vertical axis.

    A cylinder is the sum of the two sets, and the support of a sum of two sets is the sum of their supports (Schneider
    2014, Convex Bodies, section 1.7).
    """
    form, half = forms(values)[:, body, None], np.exp(values[body, None, 6])
    x, y, z = np.moveaxis(normals, -1, 0)
    squared, by = section(form, x, y, np.zeros_like(z))
    across, up = np.sqrt(np.maximum(squared, _LEAST**2)), half * np.abs(z)
    by /= (2 * across)[..., None]
    by[..., 3] = up
    rim = touched(form, x, y, z, across)
    rim[..., 2] = half * np.sign(z)
    return across + up, by, rim


def sides(values: Floats, touched: Floats) -> Floats:
    """Return the vectors (B, 4, 1, 3) along the tube from points (B, 4, 3) of its rims relative to the centres (see
    `shapes.Kind`)."""
    return touched[..., None, :] * [0.0, 0.0, -2.0]


def ranges(values: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the ranges of cylinders (see `shapes.Kind`). A ray hits where it has entered both the tube and the slab."""
    start, half = origins - values[:, :3], np.exp(values[:, 6])
    inverse = np.linalg.inv(matrices(values)[:, :2, :2])
    flat, from_axis = directions[:, :2], start[:, :2]
    a = np.maximum(np.einsum("bi,bij,bj->b", flat, inverse, flat), _FLAT)
    b = np.einsum("bi,bij,bj->b", flat, inverse, from_axis)
    c = np.einsum("bi,bij,bj->b", from_axis, inverse, from_axis) - 1
    inner = b * b - a * c
    root = np.sqrt(np.maximum(inner, 0.0))
    sign, steep = np.sign(directions[:, 2]), np.maximum(np.abs(directions[:, 2]), _FLAT)
    into_slab, out_of_slab = (-sign * start[:, 2] - half) / steep, (-sign * start[:, 2] + half) / steep
    into_tube, out_of_tube = (-b - root) / a, (-b + root) / a
    side = into_tube > into_slab
    distance = np.where(side, into_tube, into_slab)
    hit = (inner > 0) & (distance < np.minimum(out_of_slab, out_of_tube)) & (distance > 0)
    by = np.zeros((len(values), 7))
    by[:, 2], by[:, 6] = sign / steep, -half / steep
    point = from_axis + distance[:, None] * flat
    normal = np.einsum("bij,bj->bi", inverse, point)
    slope = np.where(hit & side, (normal * flat).sum(axis=1), 1.0)
    _, by_section = section(forms(values), normal[:, 0], normal[:, 1], np.zeros(len(values)))
    zero = np.zeros((len(values), 1))
    tube = np.column_stack([normal, zero, by_section[:, :3] / 2, zero]) / slope[:, None]
    by = np.where(side[:, None], tube, by)
    return np.where(hit, distance, 0.0), np.where(hit[:, None], by, 0.0), hit
