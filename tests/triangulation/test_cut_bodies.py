"""Boxes that the image's edge cuts off: their cut edges are bounds, which bodies reach or reach beyond."""

from dataclasses import replace

import numpy as np
from outlines import from_axes, visible_box
from triangulation.true_boxes import CAMERAS, edges_of, looking_at, outline_box, views_of

from objslam.triangulation.bodies.edges import LEFT, RIGHT
from objslam.triangulation.bodies.fit import Prior, Weights, fit
from objslam.triangulation.bodies.prior import weak_prior
from objslam.triangulation.bodies.residuals import at_edges, edge_gaps, nominal_noise, residuals
from objslam.triangulation.bodies.shapes import CUBOID, ELLIPSOID
from objslam.triangulation.bodies.shared import covariance_of, sides_of

CAMERA = CAMERAS["pinhole"]


def cut_views(body, count, rng):
    """Boxes (count, 4) of the visible part of an ellipsoid that the left or the right edge of the image cuts off, the poses,
    and which edges are cut off. The centre of the ellipsoid is in the image, and so are its highest and lowest points."""
    boxes, poses = [], []
    while len(boxes) < count:
        azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.6, 4)
        place = body[:3] + distance * np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.1, 0.3)])
        aside = rng.uniform(0.4, 0.65) * rng.choice([-1, 1]) * distance
        pose = looking_at(place, body[:3] + aside * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))
        whole = outline_box(CAMERA, body, pose)
        if whole is None:
            continue
        left, right = whole[0] < 0, whole[2] > CAMERA.width - 1
        inside = 80 <= (whole[0] + whole[2]) / 2 <= CAMERA.width - 81
        if left != right and inside and whole[1] > 0 and whole[3] < CAMERA.height - 1:
            boxes.append(visible_box(CAMERA, body, pose))
            poses.append(pose)
    boxes = np.array(boxes)
    bound = np.zeros((count, 4), dtype=bool)
    bound[:, LEFT], bound[:, RIGHT] = boxes[:, 0] <= 0, boxes[:, 2] >= CAMERA.width - 1
    return boxes, np.array(poses), bound


def plain(edges):
    return Weights(np.ones((len(edges), 5)), np.ones((len(edges), 5)), robust=False)


def test_a_visible_box_is_the_whole_box_clipped():
    """If the highest and lowest points are in the image, clipping the whole box gives the box of the visible part."""
    rng = np.random.default_rng(1)
    body = from_axes(np.zeros((1, 3)), np.array([[0.6, 0.4, 0.3]]), np.zeros(1))[0]
    boxes, poses, bound = cut_views(body, 20, rng)
    whole = np.array([outline_box(CAMERA, body, pose) for pose in poses])
    assert bound.sum(axis=1).tolist() == [1] * 20
    np.testing.assert_allclose(boxes, np.clip(whole, 0, [639, 479, 639, 479]), atol=0.02)


def test_a_known_body_stays_whether_its_cut_off_boxes_end_early_or_not():
    """The body reaches over each bound, so the bounds change nothing. As measured edges, they make it too small."""
    rng = np.random.default_rng(2)
    true = from_axes(np.zeros((1, 3)), np.array([[0.6, 0.35, 0.45]]), np.array([0.4]))
    whole, poses = views_of(CAMERA, true[0], 12, rng)
    known = edges_of(CAMERA, whole, poses, np.zeros(12, dtype=int))
    boxes, cut_poses, bound = cut_views(true[0], 12, rng)
    prior = Prior(true, 1e-9 * np.eye(7)[None])
    for short in (0.0, 0.05):
        early = boxes + short * bound * np.tile(boxes[:, 2:] - boxes[:, :2], 2) * [1, 1, -1, -1]
        cut = edges_of(CAMERA, early, cut_poses, np.zeros(12, dtype=int))
        one_sided, measured = known.joined(replace(cut, bound=bound)), known.joined(cut)
        found = fit(one_sided, true, prior, plain(measured), ELLIPSOID).values
        wrong = fit(measured, true, prior, plain(measured), ELLIPSOID).values
        assert np.abs(found - true).max() < 1e-3  # Boxes are exact to 0.02 px.
        assert np.abs(wrong - true).max() > 0.05


def test_a_body_that_is_only_seen_cut_off_is_pushed_outwards():
    """A ball straight ahead, of which the left edge, the top and the bottom are seen. It must reach the bound."""
    pose = looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))[None]
    box = np.array([[220.0, 140.0, 420.0, 340.0]])  # 3 m away, seen under 200 px: a radius of about 0.6 m
    small = weak_prior(np.array([[-0.35, 0.0, 0.0]]), np.array([[0.2, 0.2]]))
    free = edges_of(CAMERA, box, pose, np.zeros(1, dtype=int))
    bound = replace(free, bound=np.array([[False, False, True, False]]))
    assert edge_gaps(bound, small.mean, ELLIPSOID)[0][0, RIGHT] < -0.3
    for kind in (ELLIPSOID, CUBOID):
        found = fit(bound, small.mean, small, plain(bound), kind).values
        assert abs(edge_gaps(bound, found, kind)[0][0, RIGHT]) < 0.01  # It reaches the bound, and the prior holds it there.
        wider = np.array([0, 0, 0, 0.3, 0, 0, 0])
        beyond = residuals(bound, found + wider, kind)
        assert beyond.value[0, RIGHT] > 0
        assert beyond.use[0].tolist() == [1, 1, 0, 1, 0]  # The other edges count, and no range is known.


def test_the_covariance_with_bounds_is_that_of_repeated_boxes():
    """Three whole boxes from one side, and cut off boxes from all sides, each with 50 times other noise.

    92 to 98 % of the centres are inside their 95 % ellipsoids, and they are better than without the cut off boxes.
    """
    rng, many, times, few, cut = np.random.default_rng(3), 16, 50, 3, 6
    true = from_axes(rng.normal(0, 0.2, (many, 3)), np.tile([0.7, 0.4, 0.5], (many, 1)), rng.uniform(-1.5, 1.5, many))
    boxes, poses, bound = [], [], []
    for one in true:
        whole, cut_off = views_of(CAMERA, one, few, rng, arc=0.5), cut_views(one, cut, rng)
        boxes.append(np.concatenate([whole[0], cut_off[0]]))
        poses.append(np.concatenate([whole[1], cut_off[1]]))
        bound.append(np.concatenate([np.zeros((few, 4), dtype=bool), cut_off[2]]))
    boxes, poses, bound, true = (np.repeat(np.array(one), times, axis=0) for one in (boxes, poses, bound, true))
    boxes, poses, bound = boxes.reshape(-1, 4), poses.reshape(-1, 4, 4), bound.reshape(-1, 4)
    noisy, body = boxes + rng.normal(0, 2, bound.shape) * ~bound, np.repeat(np.arange(many * times), few + cut)
    edges = replace(edges_of(CAMERA, noisy, poses, body, sigma=2.0), bound=bound)
    start = true + rng.normal(0, 0.03, true.shape)
    weak = weak_prior(start[:, :3], np.tile([0.55, 0.5], (many * times, 1)))
    sigma = at_edges(edges, nominal_noise(edges))
    inside, spread = [], []
    for some in (np.arange(len(edges)), np.flatnonzero(~bound.any(axis=1))):
        mine = edges.take(some)
        found = fit(mine, start, weak, Weights(sigma[some] ** 2, sigma[some]), ELLIPSOID)
        told = covariance_of(mine, found, sides_of(mine, start[:, :3]), np.ones(2), np.zeros(2))[:, :3, :3]
        off = found.values[:, :3] - true[:, :3]
        inside.append(float((np.einsum("ni,nij,nj->n", off, np.linalg.inv(told), off) < 7.815).mean()))
        spread.append(np.sqrt((off**2).sum(axis=1).mean()))
    assert 0.92 <= inside[0] <= 0.98
    assert spread[0] < 0.7 * spread[1]
