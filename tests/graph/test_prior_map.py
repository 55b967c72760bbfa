"""A drive in an older map: the estimate is that of dense least squares, and shared errors of the map are accounted for."""

import numpy as np
import pytest

from objslam.core.estimate import Estimate
from objslam.core.geometry import lift_se2
from objslam.core.types import Association
from objslam.graph.maps.prior_map import MapObjects, shared_at_most, solve_in_map

TRUE = lift_se2(np.array([4.0, -2.0, 2.5]))


def spread(rng, count, sigma):
    roots = rng.normal(0, sigma, (count, 3, 3))
    return roots @ np.swapaxes(roots, 1, 2) + (0.5 * sigma) ** 2 * np.eye(3)


def scene(rng, count=8, known=5):
    """Objects at fixed poses in a frame of their own, and some of them in an older map."""
    points = rng.uniform(-3, 3, (count, 3))
    own, old = spread(rng, count, 0.02), spread(rng, known, 0.03)
    seen = points + np.array([rng.multivariate_normal(np.zeros(3), c) for c in own])
    mapped = points[:known] @ TRUE[:3, :3].T + TRUE[:3, 3]
    mapped = mapped + np.array([rng.multivariate_normal(np.zeros(3), c) for c in old])
    there = np.ones(count, dtype=bool)
    poses = np.tile(np.eye(4), (2, 1, 1))
    estimate = Estimate(poses, seen, own, np.zeros(count), there, np.ones(0), 0.0, 0.0, 0)
    return points, estimate, MapObjects(np.arange(known), mapped, old)


def solve(estimate, known):
    nothing = Association(np.zeros(0, dtype=np.int64), np.zeros(len(estimate.positions), dtype=np.int64))
    return solve_in_map(estimate, nothing, np.arange(len(estimate.positions)), known, TRUE, None)


def dense(estimate, known):
    """Gauss-Newton on x, y, z, yaw and all positions in the map, all in one dense system."""
    x, count = np.array([4.0, -2.0, 0.0, 2.5]), len(estimate.positions)
    spots = None
    for _ in range(20):
        pose = lift_se2(x[[0, 1, 3]])
        pose[2, 3] = x[2]
        moved = estimate.positions @ pose[:3, :3].T + pose[:3, 3]
        spots = moved.copy() if spots is None else spots
        a, b = np.zeros((4 + 3 * count, 4 + 3 * count)), np.zeros(4 + 3 * count)
        for j in range(count):
            row = np.zeros((3, 4 + 3 * count))
            row[:, :3], row[:2, 3] = np.eye(3), [-(moved[j] - x[:3])[1], (moved[j] - x[:3])[0]]
            row[:, 4 + 3 * j : 7 + 3 * j] = -np.eye(3)
            weight = np.linalg.inv(pose[:3, :3] @ estimate.covariance[j] @ pose[:3, :3].T + 1e-6 * np.eye(3))
            a += row.T @ weight @ row
            b += row.T @ weight @ (spots[j] - moved[j])
        for j, place, covariance in zip(known.index, known.positions, known.covariance, strict=True):
            at = slice(4 + 3 * j, 7 + 3 * j)
            weight = np.linalg.inv(covariance + 1e-6 * np.eye(3))
            a[at, at] += weight
            b[at] += weight @ (place - spots[j])
        step = np.linalg.solve(a, b)
        x, spots = x + step[:4], spots + step[4:].reshape(-1, 3)
    return x, spots, np.linalg.inv(a)


def test_the_estimate_is_that_of_dense_least_squares():
    _, estimate, known = scene(np.random.default_rng(4))
    found = solve(estimate, known)
    x, spots, covariance = dense(estimate, known)
    np.testing.assert_allclose(found.map_T_drive[:3, 3], x[:3], atol=1e-3)
    np.testing.assert_allclose(np.arctan2(found.map_T_drive[1, 0], found.map_T_drive[0, 0]), x[3], atol=1e-3)
    np.testing.assert_allclose(found.positions, spots, atol=2e-3)
    for j in range(len(spots)):  # Shared errors of the map widen it.
        at = slice(4 + 3 * j, 7 + 3 * j)
        assert np.linalg.eigvalsh(found.object_covariance[j] - 0.9 * covariance[at, at])[0] > 0
    np.testing.assert_array_equal(found.map_T_base, np.tile(found.map_T_drive, (2, 1, 1)))


@pytest.mark.parametrize("shared", ["nothing", "a shift", "a turn"])
def test_the_covariances_are_honest_also_if_the_map_is_wrong_as_a_whole(shared):
    """All objects of the map share an error as large as their covariances allow. What the drive adds is off by as much."""
    rng, squared = np.random.default_rng(5), []
    for _ in range(40):
        points, estimate, known = scene(rng)
        truth = points @ TRUE[:3, :3].T + TRUE[:3, 3]
        if shared != "nothing":
            same = 0.03**2 * np.eye(3)
            off = rng.normal(0, 0.03, 3) if shared == "a shift" else np.zeros(3)
            middle = truth[known.index].mean(axis=0)
            lever = truth[known.index] - middle
            turn = 0.0 if shared == "a shift" else rng.normal(0, 0.03 / np.linalg.norm(lever[:, :2], axis=1).max())
            wrong = truth[known.index] + off + turn * np.column_stack([-lever[:, 1], lever[:, 0], np.zeros(len(lever))])
            known = MapObjects(known.index, wrong, np.tile(same, (len(wrong), 1, 1)))
        found = solve(estimate, known)
        new = slice(len(known.index), None)
        off = (found.positions - truth)[new]
        squared += [o @ np.linalg.solve(c, o) for o, c in zip(off, found.object_covariance[new], strict=True)]
    assert np.mean(np.array(squared) > 7.815) <= 0.06  # 5 % in the mean.


def test_a_shared_error_is_no_larger_than_the_errors_of_the_objects():
    rng = np.random.default_rng(6)
    positions, covariance = rng.uniform(-3, 3, (6, 3)), spread(rng, 6, 0.05)
    pivot = positions.mean(axis=0)
    shared = shared_at_most(positions, covariance, pivot)
    lever = np.linalg.norm((positions - pivot)[:, :2], axis=1)
    deviation = np.sqrt(np.trace(covariance[:, :2, :2], axis1=1, axis2=2) / 2)
    assert np.sqrt(shared[3, 3]) == pytest.approx((deviation / lever).min())
    assert np.trace(shared[:3, :3]) == pytest.approx(np.trace(covariance, axis1=1, axis2=2).min())
    np.testing.assert_array_equal(shared[3, :3], 0.0)


def test_an_object_that_moved_since_counts_little():
    _, estimate, known = scene(np.random.default_rng(7), count=12, known=10)
    without = MapObjects(known.index[1:], known.positions[1:], known.covariance[1:])
    wrong = known.positions.copy()
    wrong[0] += [0.4, 0.0, 0.0]
    right, found = solve(estimate, without), solve(estimate, MapObjects(known.index, wrong, known.covariance))
    middle = estimate.positions.mean(axis=0)
    moved = (found.map_T_drive - right.map_T_drive) @ np.append(middle, 1.0)
    assert np.linalg.norm(moved) < 0.02  # All objects alike would move it by a tenth of 0.4 m.


@pytest.mark.parametrize("missing", [0, 3])
def test_an_unresolved_object_goes_over_without_a_covariance(missing):
    _, estimate, known = scene(np.random.default_rng(8))
    there = np.delete(np.arange(8), missing)
    nothing = Association(np.zeros(0, dtype=np.int64), np.zeros(8, dtype=np.int64))
    found = solve_in_map(estimate, nothing, there, known, TRUE, None)
    assert np.isnan(found.object_covariance[missing]).all()
    pose = found.map_T_drive
    np.testing.assert_allclose(found.positions[missing], pose[:3, :3] @ estimate.positions[missing] + pose[:3, 3])
