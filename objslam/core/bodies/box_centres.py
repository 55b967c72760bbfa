"""Where the centre of the box around an upright body is, seen from a camera."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import SHAPES

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""The corners (8, 3) of a cuboid, in units of its half axes."""
_RIMS = np.array([[np.cos(a), np.sin(a), z] for a in np.arange(16) * np.pi / 8 for z in (-1.0, 1.0)])
"""Points (32, 3) on the two rims of a cylinder, in units of its half axes. A box around 16 points of a rim is too small by
at most 2 %."""
_OUTLINES = {SHAPES.index("cuboid"): _CORNERS, SHAPES.index("cylinder"): _RIMS}
"""The points that the box of a shape goes around, by the index of the shape in `SHAPES`. The other shapes are ellipsoids,
whose boxes have a closed form."""
_NEAREST = 0.1
"""The least depth of the nearest part of a body, as a share of the depth of its centre. With a larger share, fewer bodies
near the camera get a box."""


def beside_centres(
    axes: Floats, to: Floats, half: Floats, yaw: Floats, shape: Ints, covariance: Floats
) -> tuple[Floats, Floats]:
    """Return the vector from the centre of each body to a point on the ray through the centre of its box, and its noise.

    Let a camera with the axes x, y, z see an ellipsoid with the centre c and the matrix M of squared half axes. The left and
    the right edge of its box are planes with the normal n = x - u z that touch it: (n . c)^2 = n^T M n (Hartley and
    Zisserman 2004, section 8.3). The mean of the two solutions u is the coordinate u of the point c - M z / (z . c). The box
    of a cuboid goes around the images of its corners. The box of a cylinder goes around the images of its rims. The vector
    is 0 for a body that reaches behind its camera.

    The vectors (n, 3) are in m in map. The noise (n,), m, is their standard deviation along an axis of the image, to first
    order.

    axes: (n, 3, 3) the axes of the images in map, as columns: map_R_camera for a pinhole image. to: (n, 3) m, from the
    cameras to the centres. half: (n, 3) m, the half axes along the yaw, across it and upwards. yaw: (n,) rad. shape: (n,)
    indices of `SHAPES`. covariance: (n, 4, 4) of half axes, m, and yaw, rad.
    """
    centre = (to[:, None] @ axes)[:, 0]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    body = np.stack(  # The axes of the body in the frame of the image, as columns.
        [cos * axes[:, 0] + sin * axes[:, 1], cos * axes[:, 1] - sin * axes[:, 0], axes[:, 2]], axis=2
    )
    depth, root = centre[:, 2], body * half[:, None]  # M = root root^T, in the frame of the image.
    angular = np.isin(shape, list(_OUTLINES))
    reach = np.where(angular, np.abs(root[:, 2]).sum(axis=1), np.sqrt((root[:, 2] ** 2).sum(axis=1)))
    ahead = depth - reach > _NEAREST * np.abs(depth)
    by_depth = (ahead / np.where(ahead, depth, 1.0))[:, None, None]
    slope = np.empty((len(yaw), 3, 4))  # The derivatives of the vectors in the frame of the image.
    slope[:, :, :3] = root * body[:, 2, None] * (-2 * by_depth)
    found = (slope[:, :, :3] @ half[:, :, None])[:, :, 0] / 2
    crossed = body[:, :, 0] * body[:, 2, 1, None] + body[:, :, 1] * body[:, 2, 0, None]
    slope[:, :, 3] = crossed * ((half[:, 1] ** 2 - half[:, 0] ** 2)[:, None] * by_depth[:, 0])
    for number, points in _OUTLINES.items():
        some = np.flatnonzero((shape == number) & ahead)
        if len(some):
            found[some], slope[some] = _around_points(points, centre[some], body[some], half[some])
    along = (centre / np.maximum(np.sqrt((centre * centre).sum(axis=1)), 1e-12)[:, None])[:, :, None]
    slope -= along * (along * slope).sum(axis=1, keepdims=True)
    variance = ((slope @ covariance) * slope).sum(axis=(1, 2)) / 2
    return (axes @ found[:, :, None])[:, :, 0], np.sqrt(np.maximum(variance, 0.0))


def _around_points(points: Floats, centre: Floats, body: Floats, half: Floats) -> tuple[Floats, Floats]:
    """Return the vectors (n, 3) of `beside_centres` for boxes around points, and their derivatives (n, 3, 4).

    Both are in the frame of the image. points: (P, 3) in units of the half axes. centre: (n, 3) m. body: (n, 3, 3) the axes
    of the bodies, as columns. half: (n, 3) m.
    """
    corner = centre[:, None] + points @ np.swapaxes(body * half[:, None], 1, 2)
    image = corner[:, :, :2] / corner[:, :, 2:]
    # The corner at each edge of the box: (n, 2, 2), left and top before right and bottom.
    edge = np.stack([image.argmin(axis=1), image.argmax(axis=1)], axis=1)
    at = np.take_along_axis(image, edge, axis=1)
    depth = corner[np.arange(len(centre))[:, None, None], edge, 2]
    found, slope = np.zeros((len(centre), 3)), np.zeros((len(centre), 3, 4))
    found[:, :2] = centre[:, 2:] * at.mean(axis=1) - centre[:, :2]
    by_corner = (body[:, None, :2] - at[..., None] * body[:, None, 2:]) / depth[..., None]
    sign, turned = points[edge], np.stack([by_corner[..., 1], -by_corner[..., 0]], axis=-1)
    by_yaw = (sign[..., :2] * half[:, None, None, :2] * turned).sum(axis=3)
    slope[:, :2, :3] = centre[:, 2, None, None] * (sign * by_corner).mean(axis=1)
    slope[:, :2, 3] = centre[:, 2:] * by_yaw.mean(axis=1)
    return found, slope


def image_axes(map_R_camera: Floats, to: Floats, fisheye: Bools) -> Floats:
    """Return the axes (n, 3, 3) of the images around bodies, in map, for `beside_centres`.

    For a fisheye lens, a camera that is turned towards the body gives the axes. For other lenses, the camera itself gives
    them. The distortion of such a lens bends the edges of a box a little, but the error is small compared with the vectors
    of `beside_centres`. map_R_camera: (n, 3, 3). to: (n, 3), m, from the cameras to the bodies. fisheye: (n,).
    """
    if not fisheye.any():
        return map_R_camera
    ahead = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
    right = map_R_camera[:, :, 0] - (map_R_camera[:, :, 0] * ahead).sum(axis=1, keepdims=True) * ahead
    right = right / np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    turned = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    return np.where(fisheye[:, None, None], turned, map_R_camera)
