"""Distances of centres behind the surfaces that ranges end on, against the geometry of a ball."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from objslam.config import load_settings
from objslam.core.camera import Camera
from objslam.core.noise import range_noise
from objslam.frontend.surface_ranges import half_widths, range_factors, to_centres

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), "plumb_bob", np.zeros(5))


def boxes_of(position, width):
    """The boxes (n, 4) of upright squares of this width that face along the optical axis, and the directions to them."""
    pixel = 500 * position[:, :2] / position[:, 2:] + [320, 240]
    half = 500 * width / position[:, 2:] / 2
    return np.hstack([pixel - half, pixel + half]), position / np.linalg.norm(position, axis=1, keepdims=True)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(1, 8), st.floats(0.05, 0.8), st.floats(0, 1.5))
def test_the_centre_lies_behind_the_surface_by_the_share(x, y, z, width, share):
    position = np.array([[x, y, z]])
    box, direction = boxes_of(position, width)
    half = half_widths(box, direction, [CAMERA], np.zeros(1, dtype=int))
    distance = np.linalg.norm(position)
    surface = distance - share * width / 2
    if surface > 0.3 * distance:
        assert_allclose(surface * to_centres(half, share), distance)


def test_what_is_flat_or_has_no_size_keeps_its_range():
    box, direction = boxes_of(np.array([[0.0, 0, 2], [0.0, 0, 2]]), 0.4)
    camera = np.zeros(2, dtype=int)
    half = half_widths(box, direction, [CAMERA], camera, np.array([True, False]))
    assert_allclose(half, [0, 0.1])
    unsized = Camera("front", 640, 480, CAMERA.matrix, "plumb_bob", np.zeros(5), sees_size=False)
    assert_allclose(half_widths(box, direction, [unsized], camera), 0)


def test_scale_and_surface_correct_a_range_together():
    assert_allclose(range_factors({"range_scale": 0.02, "surface": 0.5}, np.array([0.0, 0.1])), [1.02, 1.02 / 0.95])
    assert_allclose(range_factors({}, np.array([0.0, 0.1])), 1.0)
    assert (range_factors({"surface": 9.0}, np.array([0.5])) > 0).all()


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_wide_things_share_more_of_the_error_of_their_ranges(mode):
    settings = load_settings(None, (f"mode={mode}",))
    ranges, half = np.array([2.0, 2.0]), np.array([0.0, 0.2])
    _, bias = range_noise(ranges, half, np.zeros(2, dtype=int), [CAMERA], settings)
    assert_allclose(bias, [0.05, np.sqrt(0.05**2 + (0.3**2 + 0.3**2) * 0.4**2)])
