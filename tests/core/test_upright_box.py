"""The overlap of upright boxes, against counted points, and bodies that turn with their map."""

import numpy as np
import pytest

from objslam.core.bodies.body import Body, turned
from objslam.core.bodies.upright_box import footprint, overlap


def inside(points, box):
    centre, size, yaw = box
    off = points - centre
    cos, sin = np.cos(yaw), np.sin(yaw)
    local = np.column_stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]])
    return (np.abs(local) <= size / 2).all(axis=1)


@pytest.mark.parametrize("seed", range(4))
def test_the_overlap_is_the_share_of_common_points(seed):
    rng = np.random.default_rng(seed)
    one, two = ((rng.uniform(-0.3, 0.3, 3), rng.uniform(0.5, 1.5, 3), rng.uniform(-3, 3)) for _ in range(2))
    points = rng.uniform(-1.5, 1.5, (400_000, 3))
    a, b = inside(points, one), inside(points, two)
    assert overlap(one, two) == pytest.approx((a & b).sum() / (a | b).sum(), abs=0.01)
    assert overlap(one, two) == pytest.approx(overlap(two, one))
    assert overlap(one, one) == pytest.approx(1.0)


def test_boxes_apart_have_no_overlap():
    size = np.ones(3)
    assert overlap((np.zeros(3), size, 0.3), (np.array([0.0, 0.0, 1.1]), size, 0.3)) == 0.0
    assert overlap((np.zeros(3), size, 0.3), (np.array([2.0, 0.0, 0.0]), size, 0.3)) == 0.0


def test_a_footprint_goes_counter_clockwise_around_its_area():
    x, y = footprint((np.array([1.0, 2.0, 0.0]), np.array([2.0, 0.5, 1.0]), 0.7)).T
    assert (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 == pytest.approx(1.0)


def test_a_body_turns_with_its_map():
    body = Body("cuboid", np.array([2.0, 1.0, 1.0]), 1.4, np.ones(3), 0.1)
    cos, sin = np.cos(0.5), np.sin(0.5)
    found = turned(body, np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]]))
    assert found.yaw == pytest.approx(1.9 - np.pi)
