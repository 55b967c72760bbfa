"""Points that explain the rays of labels, against the simulated truth and a plain second implementation."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from objslam.mapping.checks import meeting_points
from objslam.mapping.checks.meeting_points import fit_points, nearest_point


def rays_to(points, owner, rng, noise=0.005):
    """Rays from random places 5 m around points to the point of each ray, turned by a random angle."""
    origins = rng.uniform(-5, 5, (len(owner), 3)) + 6 * rng.choice([-1, 1], (len(owner), 3))
    to = points[owner] - origins
    directions = to / np.linalg.norm(to, axis=1, keepdims=True) + noise * rng.normal(size=to.shape)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_each_object_of_each_label_gets_a_point_and_its_rays(offset):
    """Labels of 12 to 1500 rays, with one to three objects each. A tenth of the rays are false."""
    rng = np.random.default_rng(0)
    label = np.repeat(np.arange(6), [12, 12, 40, 60, 300, 1500])
    objects = np.repeat(np.arange(6), [1, 1, 1, 2, 2, 3])
    points = rng.uniform(-3, 3, (len(objects), 3))
    owner = np.array([rng.choice(np.flatnonzero(objects == one)) for one in label])
    origins, directions = rays_to(points, owner, rng)
    false = rng.random(len(label)) < 0.1
    directions[false] = rays_to(points, owner[false], rng, noise=3.0)[1]
    order = rng.permutation(len(label))
    origins, directions, label, owner, false = (a[order] for a in (origins + offset, directions, label, owner, false))
    met = fit_points(origins, directions, np.full(len(label), 0.02), 0.05, label, 0)
    found, where, fit = met.point, met.points, met.fit
    for number, truth in enumerate(points + offset):
        mine = (owner == number) & ~false
        nearest = int(np.linalg.norm(where - truth, axis=1).argmin())
        assert np.linalg.norm(where[nearest] - truth) < 0.1
        assert (found[mine] == nearest).mean() > 0.9
    held = found >= 0
    assert fit[held].min() > 0
    assert not fit[~held].any()
    assert held[false].mean() < 0.3
    # What fit means, ray by ray.
    to = where[found[held]] - origins[held]
    across = np.linalg.norm(np.cross(to, directions[held]), axis=1)
    allowed = np.hypot(0.02 * np.linalg.norm(to, axis=1), 0.05)
    np.testing.assert_allclose(fit[held], 1 - (across / allowed) ** 2, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_things_of_a_row_have_points_though_many_rays_pass_a_far_one(seed):
    """A robot drives along two rows of posts, and sees those ahead. All rays point along the rows, more or less."""
    rng = np.random.default_rng(seed)
    posts = np.array([(5.0 * k, y, 0.0) for k in range(12) for y in (-1.5, 1.5)]) + rng.normal(0, 0.05, (24, 3))
    robot = np.column_stack([np.arange(-10.0, 55.0, 0.4), *rng.normal(0, 0.03, (2, 163))])
    to = posts[None] - robot[:, None]
    ahead = (to[..., 0] > np.abs(to[..., 1])) & (to[..., 0] < 14.0)
    frame, owner = np.nonzero(ahead)
    directions = to[ahead] / np.linalg.norm(to[ahead], axis=1, keepdims=True) + 0.004 * rng.normal(size=(len(frame), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    met = fit_points(robot[frame], directions, np.full(len(frame), 0.012), 0.05, np.zeros(len(frame), dtype=int), seed)
    assert (met.point >= 0).mean() > 0.8
    near = np.linalg.norm(met.points[:, None] - posts, axis=2).min(axis=0) < 0.3
    assert near.mean() > 0.5
    assert len(np.unique(owner)) == 24


def test_other_labels_do_not_change_the_points_of_a_label():
    rng = np.random.default_rng(1)
    label = np.repeat(np.arange(40), rng.integers(4, 60, 40))
    origins, directions = rays_to(rng.uniform(-3, 3, (40, 3)), label, rng, noise=0.03)
    tolerance = np.full(len(label), 0.02)
    together = fit_points(origins, directions, tolerance, 0.05, label, 0)
    for one in range(0, 40, 7):
        mine = label == one
        alone = fit_points(origins[mine], directions[mine], tolerance[mine], 0.05, label[mine], 0)
        np.testing.assert_array_equal(together.point[mine] >= 0, alone.point >= 0)
        np.testing.assert_allclose(together.fit[mine], alone.fit, atol=1e-9)


def test_rays_that_hardly_differ_have_no_point():
    """A camera that only turns, and one that sees a thing from one side."""
    rng = np.random.default_rng(2)
    origins = 0.001 * rng.normal(size=(50, 3))
    directions = np.array([1.0, 0.0, 0.0]) + 0.005 * rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    met = fit_points(origins, directions, np.full(50, 0.02), 0.05, np.zeros(50, dtype=int), 0)
    assert (met.point == -1).all()
    assert len(met.points) == 0
    assert met.narrow.all()
    assert not met.fit.any()


def test_the_nearest_point_is_that_of_least_squares():
    rng = np.random.default_rng(3)
    start = rng.normal(size=(3, 3))
    origins, directions = (a.reshape(3, 20, 3) for a in rays_to(start, np.repeat(np.arange(3), 20), rng, noise=0.1))
    used = rng.random((3, 20)) < 0.7
    found = nearest_point(origins, directions, start, used)
    for one in range(3):
        o, d = origins[one, used[one]], directions[one, used[one]]
        distance = np.linalg.norm(start[one] - o, axis=1, keepdims=True)
        truth = least_squares(lambda x, o=o, d=d, s=distance: (np.cross(x - o, d) / s).ravel(), start[one]).x
        np.testing.assert_allclose(found[one], truth, atol=1e-6)
        np.testing.assert_allclose(nearest_point(o, d, start[one]), truth, atol=1e-6)


def test_a_ray_fits_a_point_as_its_offset_says():
    """Point by point and ray by ray: 1 on the ray, 0 from the tolerance on, behind the camera, near it, and for no ray."""
    rng, place = np.random.default_rng(1), 0.1
    origins, points = rng.uniform(-1, 1, (2, 30, 3)), rng.uniform(-3, 3, (2, 40, 3))
    directions = points[:, :30] - origins + rng.normal(0, 0.2, (2, 30, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    points[:, 30:] = origins[:, :10] + rng.uniform(-0.4, 0.4, (2, 10, 1)) * directions[:, :10]
    tolerance, real = rng.uniform(0.02, 0.2, (2, 30)), rng.random((2, 30)) < 0.9
    middle = np.zeros((2, 3))
    rows = meeting_points._Rows(np.zeros((2, 30), dtype=int), real, origins, directions, tolerance, place, middle)
    told, seen = rows.fit(points), set()
    for label, p, r in np.ndindex(told.shape):
        to = points[label, p] - origins[label, r]
        along = to @ directions[label, r]
        off = np.linalg.norm(to - along * directions[label, r])
        ratio = off / np.hypot(tolerance[label, r] * np.linalg.norm(to), place)
        near = along <= 0.25
        fits = 0.0 if near or not real[label, r] else max(1 - ratio**2, 0.0)
        assert told[label, p, r] == pytest.approx(fits, abs=1e-9)
        seen.add((near and ratio < 1 and along > 0, fits > 0.5, bool(real[label, r])))
    assert {(True, False, True), (False, True, True), (False, False, True), (False, False, False)} <= seen
