"""A map whose z axis does not point up is told, and no other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_result import OPTICAL

from objslam.core.geometry import lift_se2, make_pose
from objslam.core.types import Keyframes
from objslam.mapping.checks.upright import lies_on_its_side


def walk(turned: Rotation, roll: float) -> Keyframes:
    """A hand-held camera on a circle, its world turned as a whole, with a roll (rad) that swings."""
    n = 60
    turn = np.linspace(0, 2 * np.pi, n)
    base = lift_se2(np.column_stack([np.cos(turn), np.sin(turn), turn + np.pi / 2]))
    swing = Rotation.from_rotvec(np.column_stack([roll * np.sin(5 * turn), np.zeros(n), np.zeros(n)])).as_matrix()
    poses = make_pose(turned.as_matrix(), np.zeros(3)) @ base @ make_pose(swing, np.zeros((n, 3)))
    stamps, zeros = np.arange(n, dtype=float), np.zeros(n, dtype=np.int64)
    return Keyframes(stamps, zeros, np.arange(n), np.tile(OPTICAL, (n, 1, 1)), poses)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 0.0), ("x", 30.0), ("z", 90.0)])
def test_a_map_that_stands_is_left_alone(axis: str, degrees: float) -> None:
    assert lies_on_its_side(walk(Rotation.from_euler(axis, degrees, degrees=True), 0.1)) is None


@pytest.mark.parametrize(
    ("axis", "degrees", "up"), [("x", 90.0, "-y"), ("x", -90.0, "y"), ("y", 90.0, "x"), ("x", 180.0, "-z")]
)
def test_a_map_on_its_side_says_where_up_is(axis: str, degrees: float, up: str) -> None:
    said = lies_on_its_side(walk(Rotation.from_euler(axis, degrees, degrees=True), 0.1))
    assert said is not None
    assert f"the cameras' up is {up}, not z" in said


def test_a_camera_that_rolls_right_over_tells_nothing() -> None:
    assert lies_on_its_side(walk(Rotation.from_euler("x", 90, degrees=True), 3.0)) is None


def test_a_planar_path_needs_no_camera() -> None:
    assert lies_on_its_side(walk(Rotation.identity(), 0.0)) is None
