"""Which axis of a map points up: cameras on a robot, in visual SLAM's frame, and over a table."""

import numpy as np
import pytest

from objslam.core.geometry import make_pose
from objslam.core.types import Keyframes
from objslam.frontend.up import up_axis

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # map_R_camera: x ahead, z up.
DOWN = np.diag([1.0, -1.0, -1.0])  # The camera looks along -z, and the image's top points to y.


def keyframes(rotation: np.ndarray, way: tuple[float, float, float]) -> Keyframes:
    """A walk of 60 steps. way: (3,) m, how far it wanders along each axis of the map."""
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3)) * way
    none = np.zeros(60, dtype=np.int64)
    poses = np.array([make_pose(rotation, place) for place in places])
    return Keyframes(np.arange(60.0), none, np.arange(60), np.tile(np.eye(4), (60, 1, 1)), poses)


@pytest.mark.parametrize(
    ("rotation", "way", "up"),
    [
        (FORWARD, (4.0, 3.0, 0.01), "z"),
        (np.eye(3), (3.0, 0.3, 2.0), "-y"),  # The first camera's frame: y down, z ahead.
        (np.diag([1.0, -1.0, -1.0]), (3.0, 0.3, 2.0), "y"),  # OpenGL's: y up, z backwards.
        (DOWN, (0.4, 0.6, 0.001), "z"),
        (DOWN, (0.4, 0.6, 0.1), "z"),
    ],
)
def test_the_axis_along_which_cameras_hardly_move_points_up(rotation, way, up):
    assert up_axis(keyframes(rotation, way)) == up
