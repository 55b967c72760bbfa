"""A Kalman filter of a pose and of landmarks, against finite differences, sampled errors and batch least squares."""

import numpy as np
import pytest

from objslam.association import ekf
from objslam.core.geometry import lift_se2

PRIOR = np.array([0.05, 0.1, 0.1])  # rad, m, m
SIGMA, RANGE_SIGMA = 0.005, 0.05


def sight_from(map_T_base, points, rng=None, ranged=True):
    """Rays from a camera 0.2 m ahead of the base to points (n, 3)."""
    ahead = np.array([0.2, 0.0, 0.5])
    to = (points - map_T_base[:3, 3]) @ map_T_base[:3, :3] - ahead
    reach = np.linalg.norm(to, axis=1)
    n = to / reach[:, None]
    if rng is not None:
        n = n + SIGMA * rng.standard_normal(n.shape)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        reach = reach + RANGE_SIGMA * rng.standard_normal(len(n))
    count = len(points)
    sigmas = np.full(count, SIGMA), np.full(count, RANGE_SIGMA)
    return ekf.Sight(np.tile(ahead, (count, 1)), n, sigmas[0], reach if ranged else np.full(count, np.nan), sigmas[1])


def scene(seed, count=8):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-4, 4, (count, 2)), rng.uniform(0, 1.5, count)])
    return rng, points, lift_se2(np.array([0.3, -0.2, 0.7]))


def moved(map_T_base, error):
    """The pose with errors of yaw, x and y."""
    turned = map_T_base.copy()
    turned[:3, :3] = lift_se2(np.array([0.0, 0.0, error[0]]))[:3, :3] @ turned[:3, :3]
    turned[:2, 3] += error[1:]
    return turned


def test_jacobians_are_the_derivatives_of_the_residuals():
    _, points, base = scene(0)
    each, step = np.arange(len(points)), 1e-6
    sight = sight_from(base, points)  # at no residual, where the tangent planes do not turn

    def residual(error, shift):
        f = ekf.Filter(moved(base, error), np.zeros(0), np.zeros((27, 27)), points + shift)
        return ekf.Expected.of(f, sight, each, each)

    expected = residual(np.zeros(3), np.zeros(3))
    for i, unit in enumerate(np.eye(3)):
        by_pose = -residual(step * unit, np.zeros(3)).residual / step
        by_landmark = -residual(np.zeros(3), step * unit).residual / step
        np.testing.assert_allclose(by_pose, expected.by_pose[:, :, i], atol=1e-4)
        np.testing.assert_allclose(by_landmark, expected.by_landmark[:, :, i], atol=1e-4)


def test_a_point_behind_the_camera_fits_no_ray():
    _, points, base = scene(1)
    sight = sight_from(base, points)
    mirrored = 2 * (base[:3, 3] + sight.offset @ base[:3, :3].T) - points
    f = ekf.Filter(base, np.zeros(0), np.zeros((27, 27)), mirrored)
    each = np.arange(len(points))
    assert (np.abs(ekf.Expected.of(f, sight, each, each).residual[:, :2]) > 1e2).all()


def drive(seed):
    """A filter that saw all points twice with a motion between, and the true pose and points."""
    rng, points, base = scene(seed)
    true = moved(base, PRIOR * rng.standard_normal(3))
    f = ekf.Filter.start(base, np.array([0.05]))
    f.covariance[:3, :3] = np.diag(PRIOR**2)
    each = np.arange(len(points))
    first = sight_from(true, points, rng)
    ekf.add(f, *ekf.ends(f, first, each))
    motion, scale = lift_se2(np.array([0.8, 0.1, 0.4])), 0.05 * rng.standard_normal()
    by_shared = np.array([[0.0], [0.8], [0.1]])
    noise = np.array([0.02, 0.03, 0.01])
    yaw, x, y = by_shared[:, 0] * scale + noise * rng.standard_normal(3)
    true = true @ motion @ lift_se2(np.array([x, y, yaw]))
    ekf.predict(f, motion, by_shared, np.diag(noise**2))
    ekf.update(f, ekf.Expected.of(f, sight_from(true, points, rng), each, each))
    off = f.map_T_base[:3, :3] @ true[:3, :3].T
    pose = np.append(-np.arctan2(off[1, 0], off[0, 0]), (true - f.map_T_base)[:2, 3])
    error = np.concatenate([pose, [scale - f.shared[0]], (points - f.position).ravel()])
    return f, error


def test_errors_are_as_large_as_the_covariance_says():
    squared = []
    for seed in range(60):
        f, error = drive(seed)
        squared.append(error @ np.linalg.solve(f.covariance, error) / len(error))
    assert np.mean(squared) == pytest.approx(1.0, abs=0.15)  # of 60 x 28 squares, whose mean has a deviation of 0.035


def test_differences_of_landmarks_are_surer_than_the_landmarks():
    """The pose of the start is unknown to 0.1 m, and the same for all."""
    f, _ = drive(0)
    apart, spread = ekf.differences(f, np.array([0]), np.array([1]))
    np.testing.assert_allclose(apart[0], f.position[1] - f.position[0])
    joint = ekf.joint_differences(f, np.array([0, 2]), np.array([1, 3]), 0.1)[1]
    np.testing.assert_allclose(joint[0, :, 0], spread[0] + 0.01 * np.eye(3), atol=1e-12)
    own = f.covariance[f.columns(np.array([0]))[0][:, None], f.columns(np.array([0]))[0]]
    other = f.covariance[f.columns(np.array([1]))[0][:, None], f.columns(np.array([1]))[0]]
    assert np.trace(spread[0]) < np.trace(own) + np.trace(other)


def test_tied_landmarks_come_together_and_others_can_be_dropped():
    f, _ = drive(3)
    one, two = np.array([0]), np.array([5])
    ekf.tie(f, one, two, 1e-4)
    np.testing.assert_allclose(f.position[0], f.position[5], atol=1e-3)
    left = f.position[1:].copy()
    ekf.keep(f, np.arange(len(f)) != 0)
    np.testing.assert_array_equal(f.position, left)
    assert f.covariance.shape == (f.head + 3 * len(f),) * 2


@pytest.mark.parametrize("ranged", [True, False])
def test_every_pair_within_the_gate_is_within_reach(ranged):
    gate, left_out = 16.0, 0
    for seed in range(20):
        f, _ = drive(seed)
        rng = np.random.default_rng(seed)
        true = moved(f.map_T_base, PRIOR * rng.standard_normal(3))
        sight = sight_from(true, f.position + 0.2 * rng.standard_normal(f.position.shape), rng, ranged)
        row, column = np.divmod(np.arange(len(f) ** 2), len(f))
        expected = ekf.Expected.of(f, sight, row, column)
        spread = ekf.individual_covariances(f, expected)
        squared = np.einsum("pi,pij,pj->p", expected.residual, np.linalg.inv(spread), expected.residual)
        reach = ekf.within_reach(f, sight, np.arange(len(f)), gate)[row, column]
        assert reach[squared <= gate].all()
        left_out += int((~reach).sum())
    assert left_out > 20 * 8  # of 20 x 64 pairs
