"""Rotations as matrices (..., 3, 3), as vectors (..., 3) and as unit quaternions (..., 4) x, y, z, w, in batches.

They are plain arrays. `scipy.spatial.transform` does the same, but its import takes longer than the mapping of a small log.
"""

import numpy as np

from objslam.core.arrays import Floats

_SMALL = 1e-4
"""The sine of a rotation angle, or of half of the angle, below which a series replaces angle / sine. Near 0, the ratio would
be 0 / 0. A larger value makes the series less exact. At this value, its relative error is below 1e-17."""


def _cross_product_map() -> Floats:
    """Return the linear map (3, 9) from x, y, z to the nine entries of the cross-product matrix."""
    cross = np.zeros((3, 9))
    cross[[1, 2, 0], [2, 3, 7]] = 1.0
    cross[[2, 0, 1], [1, 5, 6]] = -1.0
    return cross


_CROSS = _cross_product_map()


def skew(v: Floats) -> Floats:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    return np.asarray(v @ _CROSS).reshape(*v.shape, 3)


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products (..., 3) of vectors (..., 3).

    `np.cross` returns the same numbers. For some hundred vectors it takes three times as long.
    """
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=product[..., i])
    return product


def dots(a: Floats | tuple[Floats, ...], b: Floats) -> Floats:
    """Return the dot products (P,) of pairs of vectors (3, P), one in each column."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def rotation_from_vector(omega: Floats) -> Floats:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their lengths, rad (Rodrigues' formula)."""
    squared = np.einsum("...i,...i->...", omega, omega)
    small = squared < _SMALL**2
    divisor = np.where(small, 1.0, squared)
    angle = np.sqrt(divisor)
    cosine = np.where(small, 1 - squared / 2 + squared**2 / 24, np.cos(angle))
    sine = np.where(small, 1 - squared / 6, np.sin(angle) / angle)
    twice = np.where(small, 0.5 - squared / 24, (1 - np.cos(angle)) / divisor)
    rotation = np.empty((*omega.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        both, across = twice * omega[..., j] * omega[..., k], sine * omega[..., i]
        rotation[..., i, i] = cosine + twice * omega[..., i] ** 2
        rotation[..., k, j] = both + across
        rotation[..., j, k] = both - across
    return rotation


def rotation_vector(rotation: Floats) -> Floats:
    """Return the vectors (..., 3) about which rotations (..., 3, 3) turn, with the angles, rad in [0, pi], as lengths."""
    r = rotation
    cosine = (r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1) / 2
    if not (cosine > 0).all():  # The sine of an angle near pi is small, so that the axis would be inexact.
        return _vector_of_quaternion(quaternion_from_rotation(rotation))
    axis = np.empty(r.shape[:-1])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(r[..., k, j], r[..., j, k], out=axis[..., i])
    axis /= 2
    sine = np.sqrt(np.einsum("...i,...i->...", axis, axis))
    small = sine < _SMALL
    axis *= np.where(small, 1 + sine**2 / 6, np.arctan2(sine, cosine) / np.where(small, 1.0, sine))[..., None]
    return axis


def _vector_of_quaternion(xyzw: Floats) -> Floats:
    """Return the rotation vectors (..., 3) of unit quaternions (..., 4) x, y, z, w with w >= 0."""
    sine, cosine = np.linalg.norm(xyzw[..., :3], axis=-1, keepdims=True), xyzw[..., 3:]
    small = sine < _SMALL
    angle = 2 * np.arctan2(sine, cosine)
    return np.asarray(xyzw[..., :3] * np.where(small, 2 + sine**2 / 3, angle / np.where(small, 1.0, sine)))


def rotation_from_quaternion(xyzw: Floats) -> Floats:
    """Return the rotations (..., 3, 3) of quaternions (..., 4) x, y, z, w of any length above zero."""
    x, y, z, w = np.moveaxis(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    rows = (
        (x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), y * y - x * x - z * z + w * w, 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), z * z - x * x - y * y + w * w),
    )
    rotation = np.empty((*x.shape, 3, 3))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            rotation[..., i, j] = entry
    return rotation


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """Return the unit quaternions (..., 4) x, y, z, w with w >= 0 of rotations (..., 3, 3) (Shepperd 1978).

    If w = 0, both q and -q have w >= 0. Then the first number of the result that is not 0 is positive.
    """
    # Row i is 4 q[i] q, where q is the quaternion. The row with the largest diagonal entry is the most exact row.
    outer = np.empty((*rotation.shape[:-2], 4, 4))
    diagonal = np.diagonal(rotation, axis1=-2, axis2=-1)
    trace = diagonal.sum(axis=-1)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., i, i] = 1 + 2 * diagonal[..., i] - trace
        outer[..., i, j] = outer[..., j, i] = rotation[..., i, j] + rotation[..., j, i]
        outer[..., i, 3] = outer[..., 3, i] = rotation[..., k, j] - rotation[..., j, k]
    outer[..., 3, 3] = 1 + trace
    row = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    xyzw = np.take_along_axis(outer, row[..., None, None], axis=-2)[..., 0, :]
    x, y, z, w = np.moveaxis(xyzw, -1, 0)
    first = np.where(w != 0, w, np.where(x != 0, x, np.where(y != 0, y, z)))
    return np.asarray(xyzw * (np.where(first < 0, -1.0, 1.0) / np.linalg.norm(xyzw, axis=-1))[..., None])
