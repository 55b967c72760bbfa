"""A calibration in words: each camera is turned by a rotation whose effect is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.core.camera import Camera
from objslam.core.geometry import make_pose
from objslam.sources.camera_words import doubts_of, view_of

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: the camera's right, down and forward in base


def camera(turn=None, height=0.3, fx=500.0, fy=500.0, **more):
    rotation = AHEAD if turn is None else Rotation.from_euler("zyx", turn, degrees=True).as_matrix() @ AHEAD
    matrix = np.array([[fx, 0, 319.5], [0, fy, 239.5], [0, 0, 1]])
    return Camera("front", 640, 480, matrix, base_T_camera=make_pose(rotation, np.array([0.1, 0, height])), **more)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ((0, 0, 0), "looks ahead, 0.30 m"),
        ((90, 0, 0), "looks left, 0.30 m"),
        ((-45, 0, 0), "looks ahead and right, 0.30 m"),
        ((180, 0, 0), "looks behind, 0.30 m"),
        ((0, 20, 0), "looks ahead, 20 degrees down, 0.30 m"),
        ((0, -20, 0), "looks ahead, 20 degrees up, 0.30 m"),
        ((0, 90, 0), "looks down, 0.30 m"),
        ((0, -90, 0), "looks up, 0.30 m"),
        ((0, 0, 180), "looks ahead, upside down, 0.30 m"),
        ((0, 0, 30), "looks ahead, tilted by 30 degrees, 0.30 m"),
    ],
)
def test_where_a_camera_looks(turn, words):
    assert view_of(camera(turn)).startswith(words)
    assert not doubts_of(camera(turn))


def test_how_high_and_how_wide():
    assert view_of(camera(fx=320.0, fy=320.0, height=-0.05)) == "looks ahead, 0.05 m below base, 90 degrees wide"
    fisheye = camera(fx=400.0, fy=400.0, distortion_model="equidistant", distortion=np.zeros(4))
    assert view_of(fisheye).endswith(f"{np.degrees(640 / 400):.0f} degrees wide")


def test_a_camera_without_rotation_looks_nowhere_and_is_doubted():
    plain = Camera("front", 640, 480, camera().matrix, base_T_camera=np.eye(4))
    assert view_of(plain).startswith("0.00 m above base")
    (doubt,) = doubts_of(plain)
    assert "[-0.5, 0.5, -0.5, 0.5]" in doubt
    np.testing.assert_allclose(Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).as_matrix(), AHEAD, atol=1e-12)


def test_focal_lengths_far_apart_are_doubted():
    (doubt,) = doubts_of(camera(fx=50.0))
    assert "fx 50 px and fy 500 px" in doubt
