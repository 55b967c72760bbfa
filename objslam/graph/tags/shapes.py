"""The frame of a square fiducial (AprilTag, ArUco), and the square nearest to four corners."""

import numpy as np

from objslam.core.arrays import Bools, Floats

COUNTER_CLOCKWISE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""(4, 3) the corners of a tag of side 1 in its own frame, if they go round counter-clockwise in the image, as AprilTag's do.
x goes from the first corner to the second, and z from the tag to the viewer."""
CLOCKWISE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""(4, 3) the same, if they go round clockwise, as ArUco's do. The axes are the same too."""


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
