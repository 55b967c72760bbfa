"""The frame of a square fiducial (AprilTag, ArUco), and the square nearest to four corners."""

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.rotation import skew

COUNTER_CLOCKWISE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""(4, 3) the corners of a tag of side 1 in its own frame, if they go round counter-clockwise in the image, as AprilTag's do.
x goes from the first corner to the second, and z from the tag to the viewer."""
CLOCKWISE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""(4, 3) the same for corners that go round clockwise, as ArUco's do. The axes are defined in the same way."""


def goes_clockwise(directions: Floats) -> Bools:
    """Return whether the corners of tags go round clockwise in the image, by their directions (V, 4, 3) from the camera."""
    one, two = directions[:, 2] - directions[:, 0], directions[:, 3] - directions[:, 1]
    # The camera looks along z with y down, so a positive cross product along the view is clockwise.
    return np.asarray(np.einsum("vi,vi->v", np.cross(one, two), directions.mean(axis=1)) > 0)


def squares_of(corners: Floats, shapes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the rotations (T, 3, 3), centres (T, 3) and sides (T,) of the squares nearest to corners (T, 4, 3).

    shapes: (T, 4, 3) the corners of each tag of side 1 in its own frame. Least squares (Kabsch 1976), without weights.
    """
    centre = corners.mean(axis=1)
    u, size, vt = np.linalg.svd(np.swapaxes(corners - centre[:, None], 1, 2) @ shapes[:, :, :2], full_matrices=False)
    axes = u @ vt
    rotation = np.concatenate([axes, np.cross(axes[:, :, 0], axes[:, :, 1])[:, :, None]], axis=2)
    return rotation, centre, size.sum(axis=1) / (shapes**2).sum(axis=(1, 2))


def turned_by_squares(local: Floats, rotation: Floats) -> Floats:
    """Return the derivatives (T, 12, 7) of the corners of squares in map: by rotation and position in the frame of the
    square, and by the logarithm of the side.

    local: (T, 4, 3) m, the corners in this frame. rotation: (T, 3, 3).
    """
    count = len(local)
    columns = [-skew(local), np.broadcast_to(np.eye(3), (count, 4, 3, 3)), local[..., None]]
    turned = np.einsum("tij,tcjk->tcik", rotation, np.concatenate(columns, axis=3))
    return np.asarray(turned.reshape(count, 12, 7))
