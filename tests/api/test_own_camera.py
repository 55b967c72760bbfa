"""`objslam.Camera` refuses what no camera has, in one sentence."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import objslam

MATRIX = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])


def with_entry(row: int, column: int, value: float) -> np.ndarray:
    changed = MATRIX.copy()
    changed[row, column] = value
    return changed


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"matrix": with_entry(0, 0, -500)}, r"focal length \(-500, 500\) px is not above zero"),
        ({"matrix": with_entry(1, 1, 0)}, r"focal length \(500, 0\) px is not above zero"),
        ({"matrix": np.zeros((3, 3))}, "or zero"),
        ({"matrix": with_entry(0, 2, np.nan)}, "not finite"),
        ({"matrix": with_entry(2, 0, 1.0)}, "not fx 0 cx, 0 fy cy, 0 0 1"),
        (
            {"matrix": with_entry(0, 2, 32000.0)},
            r"principal point \(32000, 240\) px is far outside its image of 640",
        ),
        ({"matrix": np.eye(4)}, r"matrix is \(3, 3\), got the shape \(4, 4\)"),
        ({"width": 0}, "without a size"),
        ({"distortion": [0.1, 0.2]}, "takes 4 or 5 coefficients, got 2"),
        ({"base_T_camera": 2 * np.eye(4)}, "mount is not a rigid pose"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_when_it_is_made(change: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=rf"^camera 'front'.*{told}"):
        objslam.Camera(**{"name": "front", "width": 640, "height": 480, "matrix": MATRIX, **change})


def test_lists_become_arrays_and_a_copy_is_a_camera() -> None:
    camera = objslam.Camera("front", 640, 480, MATRIX.tolist(), distortion=[0.0] * 5)
    assert camera.focal == 500.0
    assert np.array_equal(deepcopy(replace(camera, width=320)).matrix, MATRIX)


def test_a_part_of_an_image_may_have_its_principal_point_outside() -> None:
    assert objslam.Camera("corner", 100, 100, MATRIX).size.tolist() == [100.0, 100.0]
