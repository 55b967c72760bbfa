"""Upright ellipsoids by seven parameters without a singularity.

The parameters are the centre x, y, z (m), three numbers p, q, s of the horizontal section, and the logarithm k of the half
axis upwards (m). The matrix of squared half axes of the horizontal section is exp(2 [[p + q, s], [s, p - q]]). So a round
section needs no yaw, and a prior around q = s = 0 prefers no direction.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

_ROUND = 1e-3
"""The aspect, sqrt(q^2 + s^2), below which a series replaces a division by the aspect. With a larger value, the series is
less exact."""
_LEAST = 1e-9
"""The least length (m) of a divisor. A larger length distorts small bodies."""


def forms(values: Floats) -> Floats:
    """Return ten numbers (10, N) that give the form v^T M v of ellipsoids (N, 7) for any vector v = (x, y, z).

    M is the matrix of squared half axes. Numbers 1 to 3 are the factors of x^2 + y^2, x^2 - y^2 and 2 x y in the form.
    Numbers 4 to 6 are the same factors in the derivative of the form by q, and numbers 7 to 9 in its derivative by s. The
    last number is the factor of z^2 in the form.
    """
    p, q, s, k = values[:, 3:].T
    aspect2 = q * q + s * s
    aspect = np.sqrt(aspect2)
    round_ = aspect < _ROUND
    safe = np.where(round_, 1.0, aspect)
    # sinh(2 a) / a, and its derivative by a divided by a
    gain = np.where(round_, 2 + 4 / 3 * aspect2, np.sinh(2 * safe) / safe)
    slope = np.where(round_, 8 / 3 + 16 / 15 * aspect2, (2 * safe * np.cosh(2 * safe) - np.sinh(2 * safe)) / safe**3)
    level = np.stack([np.cosh(2 * aspect), gain * q, gain * s])
    by_q = np.stack([2 * gain * q, slope * q * q + gain, slope * q * s])
    by_s = np.stack([2 * gain * s, slope * q * s, slope * s * s + gain])
    return np.concatenate([np.exp(2 * p) * np.concatenate([level, by_q, by_s]), np.exp(2 * k)[None]])


def section(form: Floats, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the quadratic form v^T M v (...,) of vectors v = (x, y, z), and its derivatives (..., 4) by p, q, s and k.

    M is the matrix of squared half axes. If v is the unit normal of a tangent plane, the square root of the form is the
    distance of this plane from the centre. form: (10, ...) from `forms`, for the ellipsoid of each vector.
    """
    across, along, cross, upward = x * x + y * y, x * x - y * y, 2 * x * y, form[9] * z * z
    by = np.empty((*across.shape, 4), order="F")
    flat, by[..., 1], by[..., 2] = (a * across + b * along + c * cross for a, b, c in (form[:3], form[3:6], form[6:9]))
    by[..., 0], by[..., 3] = 2 * flat, 2 * upward
    return flat + upward, by


def support(values: Floats, body: Ints, normals: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the support of ellipsoids (see `shapes.Kind`): the square root of n^T M n for a normal n (the dual quadric)."""
    form = forms(values)[:, body, None]
    x, y, z = np.moveaxis(normals, -1, 0)
    squared, by = section(form, x, y, z)
    distance = np.sqrt(np.maximum(squared, _LEAST**2))
    by /= (2 * distance)[..., None]
    return distance, by, touched(form, x, y, z, distance)


def touched(form: Floats, x: Floats, y: Floats, z: Floats, distance: Floats) -> Floats:
    """Return the products M n (B, 4, 3) for normals n = (x, y, z), each divided by a distance (B, 4), m.

    If the distance is the support, the result is the touched point relative to the centre, m. form: as in `section`.
    """
    points = np.empty((*distance.shape, 3), order="F")
    points[..., 0] = ((form[0] + form[1]) * x + form[2] * y) / distance
    points[..., 1] = (form[2] * x + (form[0] - form[1]) * y) / distance
    points[..., 2] = form[9] * z / distance
    return points


def sides(values: Floats, touched: Floats) -> Floats:
    """Return no vectors (B, 4, 0, 3), because an ellipsoid has no straight sides (see `shapes.Kind`)."""
    return np.zeros((*touched.shape[:2], 0, 3))


def ranges(values: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the ranges of ellipsoids (see `shapes.Kind`): the nearer root of a quadratic equation."""
    inverse, start = np.linalg.inv(matrices(values)), origins - values[:, :3]
    a = np.einsum("bi,bij,bj->b", directions, inverse, directions)
    b = np.einsum("bi,bij,bj->b", directions, inverse, start)
    c = np.einsum("bi,bij,bj->b", start, inverse, start) - 1
    inner = b * b - a * c
    hit = (inner > 0) & (c > 0) & (b < 0)
    distance = np.where(hit, (-b - np.sqrt(np.where(hit, inner, 0.0))) / a, 0.0)
    normal = np.einsum("bij,bj->bi", inverse, start + distance[:, None] * directions)
    slope = np.where(hit, (normal * directions).sum(axis=1), 1.0)
    _, by = section(forms(values), *normal.T)
    return distance, np.where(hit[:, None], np.column_stack([normal, by / 2]) / slope[:, None], 0.0), hit


def matrices(values: Floats) -> Floats:
    """Return the matrices M (N, 3, 3) of squared half axes, m^2, of ellipsoids (N, 7)."""
    half, yaw = half_axes(values), heading(values)
    cos, sin = np.cos(yaw), np.sin(yaw)
    a, b, c = (half**2).T
    matrix = np.zeros((len(values), 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2] = a * cos**2 + b * sin**2, a * sin**2 + b * cos**2, c
    matrix[:, 0, 1] = matrix[:, 1, 0] = (a - b) * cos * sin
    return matrix


def half_axes(values: Floats) -> Floats:
    """Return the half axes (N, 3), m, of ellipsoids (N, 7): the long and the short horizontal one, and the upward one."""
    aspect = np.hypot(values[:, 4], values[:, 5])
    return np.exp(np.column_stack([values[:, 3] + aspect, values[:, 3] - aspect, values[:, 6]]))


def heading(values: Floats) -> Floats:
    """Return the yaw (N,), rad in (-pi/2, pi/2], of the long horizontal axis of ellipsoids (N, 7)."""
    return np.asarray(0.5 * np.arctan2(values[:, 5], values[:, 4]))


def axes_jacobian(values: Floats) -> Floats:
    """Return the derivatives (N, 7, 7) of centre, half axes and yaw by the parameters of ellipsoids (N, 7).

    A round section has no yaw. The derivatives of its yaw are computed at an aspect of 1e-3.
    """
    half, twice = half_axes(values), 2 * heading(values)
    aspect = np.maximum(np.hypot(values[:, 4], values[:, 5]), _ROUND)
    cos, sin = np.cos(twice), np.sin(twice)
    by = np.zeros((len(values), 7, 7))
    by[:, [0, 1, 2], [0, 1, 2]] = 1.0
    for row, sign in ((3, 1.0), (4, -1.0)):
        by[:, row, 3] = half[:, row - 3]
        by[:, row, 4], by[:, row, 5] = sign * half[:, row - 3] * cos, sign * half[:, row - 3] * sin
    by[:, 5, 6] = half[:, 2]
    by[:, 6, 4], by[:, 6, 5] = -sin / (2 * aspect), cos / (2 * aspect)
    return by
