"""Where the centre of the box around an upright body is, seen from a camera."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""The corners (8, 3) of a cuboid, in half axes."""
_STEP = 1e-3
"""The step of the differences, as a share of a half axis, or rad of yaw. A larger step is less exact."""
_NEAREST = 0.1
"""The least depth of the nearest part of a body, as a share of the depth of its centre. A larger share gives fewer bodies
that nearly touch the camera a box."""


def beside_centres(axes: Floats, to: Floats, half: Floats, yaw: Floats, cuboid: Bools) -> Floats:
    """Return vectors (n, 3), m in map, from the centres of bodies to points on the rays through the centres of their boxes.

    Let a camera with the axes x, y, z see an ellipsoid with the centre c and the matrix M of squared half axes. The left and
    the right edge of its box are planes with the normal n = x - u z that touch it: (n . c)^2 = n^T M n (Hartley and
    Zisserman 2004, section 8.3). The mean of the two solutions u is that of the point c - M z / (z . c). The box of a cuboid
    goes around the images of its corners.

    axes: (n, 3, 3) the axes of the images in map, as columns: map_R_camera for a pinhole image. to: (n, 3) m, from the
    cameras to the centres. half: (n, 3) m, the half axes along the yaw, across it and upwards. yaw: (n,) rad. cuboid: (n,)
    False for an ellipsoid. The vector is 0 for a body that reaches behind its camera.
    """
    centre = np.einsum("nji,nj->ni", axes, to)
    cos, sin, turn = np.cos(yaw), np.sin(yaw), np.zeros((len(yaw), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, -sin, sin, cos, 1.0
    root = np.swapaxes(axes, 1, 2) @ turn * half[:, None, :]  # M = root root^T, in the frame of the image.
    depth = centre[:, 2]
    reach = np.where(cuboid, np.abs(root[:, 2]).sum(axis=1), np.sqrt((root[:, 2] ** 2).sum(axis=1)))
    ahead = depth - reach > _NEAREST * np.abs(depth)
    safe = np.where(ahead, depth, 1.0)
    found = -(root @ root[:, 2, :, None])[:, :, 0] / safe[:, None]
    some = np.flatnonzero(cuboid & ahead)
    if len(some):
        corner = centre[some, None] + _CORNERS @ np.swapaxes(root[some], 1, 2)
        image = corner[..., :2] / corner[..., 2:]
        middle = (image.min(axis=1) + image.max(axis=1)) / 2
        found[some, :2] = depth[some, None] * middle - centre[some, :2]
        found[some, 2] = 0.0
    return np.einsum("nij,nj->ni", axes, np.where(ahead[:, None], found, 0.0))


def beside_centres_sigma(
    axes: Floats, to: Floats, half: Floats, yaw: Floats, cuboid: Bools, covariance: Floats
) -> tuple[Floats, Floats]:
    """Return `beside_centres` (n, 3), m, and the standard deviations (n,), m, of these vectors along an axis of the image.

    covariance: (n, 4, 4) of half axes, m, and yaw, rad.
    """
    n = len(yaw)
    step = np.concatenate([_STEP * half, np.full((n, 1), _STEP)], axis=1)
    moved = np.tile(np.concatenate([half, yaw[:, None]], axis=1), (5, 1, 1))
    moved[range(1, 5), :, range(4)] += step.T
    flat = moved.reshape(-1, 4)
    views = np.tile(axes, (5, 1, 1)), np.tile(to, (5, 1))
    found = beside_centres(*views, flat[:, :3], flat[:, 3], np.tile(cuboid, 5)).reshape(5, n, 3)
    by = (found[1:] - found[0]) / step.T[..., None]
    along = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
    by -= (by * along).sum(axis=2, keepdims=True) * along
    variance = np.einsum("ani,nab,bni->n", by, covariance, by) / 2
    return found[0], np.sqrt(np.maximum(variance, 0.0))


def image_axes(map_R_camera: Floats, to: Floats, fisheye: Bools) -> Floats:
    """Return the axes (n, 3, 3) of the images around bodies, in map, for `beside_centres`.

    The image of a fisheye lens around a body is that of a camera turned towards it. A lens with a mild distortion bends the
    edges of a box a little. The error is small beside the vectors. map_R_camera: (n, 3, 3). to: (n, 3), m, from the cameras
    to the bodies. fisheye: (n,).
    """
    if not fisheye.any():
        return map_R_camera
    ahead = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
    right = map_R_camera[:, :, 0] - (map_R_camera[:, :, 0] * ahead).sum(axis=1, keepdims=True) * ahead
    right = right / np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    turned = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    return np.where(fisheye[:, None, None], turned, map_R_camera)
