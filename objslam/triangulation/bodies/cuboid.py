"""Upright cuboids by seven parameters.

The parameters are the centre x, y, z (m), p, q, the yaw (rad), and k. p is the mean of the logarithms of the two horizontal
half axes (m). q is half the difference of the two logarithms, and may be negative. k is the logarithm of the half axis
upwards (m).
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

_FLAT = 1e-12
"""The least component of a ray's unit direction along an axis of the cuboid. It prevents a division by zero. A larger value
distorts rays that are nearly parallel to a face."""


def _half(values: Floats) -> Floats:
    p, q, k = values[..., 3], values[..., 4], values[..., 6]
    return np.exp(np.stack([p + q, p - q, k], axis=-1))


def _local(values: Floats, vectors: Floats) -> Floats:
    """Return vectors (..., 3) in the frames of cuboids (..., 7)."""
    cos, sin = np.cos(values[..., 5]), np.sin(values[..., 5])
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([cos * x + sin * y, cos * y - sin * x, z + 0 * cos], axis=-1)


def support(values: Floats, body: Ints, normals: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the support of cuboids (see `shapes.Kind`). A plane touches the corner that is farthest along its normal."""
    cos, sin = (part(values[:, 5])[body, None] for part in (np.cos, np.sin))
    half = _half(values).T[:, body, None]
    x, y, z = np.moveaxis(normals, -1, 0)
    local = np.stack([cos * x + sin * y, cos * y - sin * x, z])
    across, along, up = corner = np.sign(local) * half  # in the frame of the cuboid
    a, b, c = reach = corner * local
    by, points = np.empty((*z.shape, 4), order="F"), np.empty((*z.shape, 3), order="F")
    by[..., 0], by[..., 1], by[..., 2], by[..., 3] = a + b, a - b, across * local[1] - along * local[0], c
    points[..., 0], points[..., 1], points[..., 2] = cos * across - sin * along, sin * across + cos * along, up
    return reach.sum(axis=0), by, points


def sides(values: Floats, touched: Floats) -> Floats:
    """Return the vectors (B, 4, 3, 3) along the sides that end at corners (B, 4, 3) relative to the centres (see
    `shapes.Kind`)."""
    back = values * [1, 1, 1, 1, 1, -1, 1]
    along = -2 * _local(values, touched)[..., None] * np.eye(3)
    return _local(back[..., None, :], along)


def ranges(values: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the ranges of cuboids (see `shapes.Kind`). A ray hits where it enters its last slab (Kay, Kajiya 1986)."""
    start, along, half = _local(values, origins - values[:, :3]), _local(values, directions), _half(values)
    sign, steep = np.sign(along), np.maximum(np.abs(along), _FLAT)
    enter, leave = (-sign * start - half) / steep, (-sign * start + half) / steep
    axis = enter.argmax(axis=1)
    rows = np.arange(len(values))
    distance = enter[rows, axis]
    hit = (distance < leave.min(axis=1)) & (distance > 0)
    sign, steep = sign[rows, axis], steep[rows, axis]
    by = np.zeros((len(values), 7))
    unit = _local(values * [1, 1, 1, 1, 1, -1, 1], np.eye(3)[axis])
    by[:, :3] = (sign / steep)[:, None] * unit
    size = half[rows, axis] / steep
    by[:, 3], by[:, 4], by[:, 6] = -size * (axis < 2), size * ((axis == 1) * 1.0 - (axis == 0)), -size * (axis == 2)
    turned, faster = np.where(axis == 0, start[:, 1], -start[:, 0]), np.where(axis == 0, along[:, 1], -along[:, 0])
    by[:, 5] = np.where(axis < 2, -sign * (turned + distance * faster) / steep, 0.0)
    return np.where(hit, distance, 0.0), np.where(hit[:, None], by, 0.0), hit


def half_axes(values: Floats) -> Floats:
    """Return the half axes (N, 3), m, of cuboids (N, 7): the long and the short horizontal one, and the upward one."""
    half = _half(values)
    return np.column_stack([half[:, :2].max(axis=1), half[:, :2].min(axis=1), half[:, 2]])


def heading(values: Floats) -> Floats:
    """Return the yaw (N,), rad in (-pi/2, pi/2], of the long horizontal axis of cuboids (N, 7)."""
    yaw = values[:, 5] + np.where(values[:, 4] < 0, np.pi / 2, 0.0)
    return np.asarray(np.pi / 2 - (np.pi / 2 - yaw) % np.pi)


def axes_jacobian(values: Floats) -> Floats:
    """Return the derivatives (N, 7, 7) of centre, half axes and yaw by the parameters of cuboids (N, 7)."""
    half, sign = half_axes(values), np.where(values[:, 4] < 0, -1.0, 1.0)
    by = np.zeros((len(values), 7, 7))
    by[:, [0, 1, 2], [0, 1, 2]] = 1.0
    by[:, 3, 3], by[:, 3, 4] = half[:, 0], sign * half[:, 0]
    by[:, 4, 3], by[:, 4, 4] = half[:, 1], -sign * half[:, 1]
    by[:, 5, 6] = half[:, 2]
    by[:, 6, 5] = 1.0
    return by
