"""Bodies of things that were seen from one side: the best cuboid is found, and the sigmas hold what boxes do not tell."""

import numpy as np
import pytest
from triangulation.true_boxes import CAMERAS, boxes_of_outlines, corners_of, edges_of, inside, solved

from objslam.mapping.bodies.fitting import _body, repeated_error
from objslam.triangulation.bodies.fit import Prior, fit
from objslam.triangulation.bodies.shapes import CUBOID
from objslam.triangulation.bodies.shared import UNLIKE, covariance_of, covariance_with_unlike, sides_of, weights_of

MANY = 60


def seen_over(arc, outline, each):
    """Things of 0.3 to 0.8 m seen over an arc, rad. Their bodies, and the errors (MANY, 3) of the centres, m.

    outline: takes half axes and a yaw, and returns points of a thing around its centre. each: the number of boxes of each.
    """
    rng = np.random.default_rng(8)
    half = rng.uniform(0.15, [0.3, 0.3, 0.4], (MANY, 3))
    boxes, poses = boxes_of_outlines(CAMERAS["pinhole"], [outline(h, rng.uniform(0, 3)) for h in half], rng, each, arc)
    true = np.column_stack([np.zeros((MANY, 2)), half[:, 2]])
    found = solved(CAMERAS["pinhole"], boxes, poses, true + rng.normal(0, 0.05, true.shape), half[:, [0, 2]])
    return found, found.axes[:, :3] - true


def prism(half, yaw):
    """The corners of a hexagonal prism."""
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    angle = np.radians(np.arange(0, 360, 60))
    rims = [np.column_stack([np.cos(angle), np.sin(angle), np.full(6, z)]) for z in (-1, 1)]
    return np.concatenate(rims) * half @ turn


def test_the_cuboid_of_another_heading_and_depth_is_found():
    """The fit ended at a cuboid of a wrong heading, up to 0.1 m too near or too far, which is far less probable."""
    found, off = seen_over(np.radians(30), corners_of, 60)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.022
    assert inside(off, found.centre_covariance) >= 0.95


def test_a_thing_that_is_no_body_is_as_unsure_as_its_outline_is_unlike():
    found, off = seen_over(np.radians(30), prism, 60)
    repeated = np.array([repeated_error(found.share[0], axes) for axes in found.axes[:, 3:6]])[:, None, None]
    exact = found.centre_covariance + repeated**2 * np.eye(3)
    assert inside(off, exact) < 0.9
    assert inside(off, exact + found.unlike[:, :3, :3]) >= 0.92
    placed = _body(found, 0, np.zeros((3, 3)), np.zeros((6, 6)), clear=True)
    np.testing.assert_allclose(placed.covariance[:3, :3], exact[0] + found.unlike[0, :3, :3], rtol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1])
def test_what_is_unlike_adds_to_smaller_shared_errors(share):
    rng, camera, half = np.random.default_rng(3), CAMERAS["pinhole"], np.array([0.3, 0.2, 0.25])
    boxes, poses = boxes_of_outlines(camera, [corners_of(half, 0.4)], rng, 24, 1.0)
    edges = edges_of(camera, boxes, poses, np.zeros(24, dtype=int))
    sides = sides_of(edges, np.array([[0, 0, 0.25]]))
    shares, ones = np.full(2, share), np.ones(2)
    start = np.array([[0, 0, 0.25, np.log(0.06) / 2, np.log(1.5) / 2, 0.4, np.log(0.25)]])
    found = fit(edges, start, Prior(start, np.eye(7)[None]), weights_of(edges, sides.number, ones, shares), CUBOID)
    told, unlike = covariance_with_unlike(edges, found, sides, ones, shares)
    larger = covariance_of(edges, found, sides, ones, np.maximum(shares, UNLIKE))
    np.testing.assert_allclose(told + unlike, larger, rtol=1e-9, atol=1e-15)
    assert (np.abs(unlike).max() > 1e-6) == (share < UNLIKE)
