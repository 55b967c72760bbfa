"""The error that all objects of a map share, against finite moves of points and the joint covariance it came from."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.core.maps.shared_covariance import jacobian, moved, own_part, root_of, shared_covariance

SIGMAS = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.03, 0.015])


def drawn(seed, count=12):
    """Points, their own covariances, and the covariance of a shared error with correlations."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(4, 12, (count, 2)), rng.uniform(0, 2, count)])
    own = rng.normal(0, 0.02, (count, 3, 3))
    turn = np.linalg.qr(rng.normal(size=(7, 7)))[0]
    correlation = turn @ np.diag(np.linspace(0.2, 2.0, 7)) @ turn.T
    return points, own @ np.swapaxes(own, 1, 2) + 1e-4 * np.eye(3), SIGMAS[:, None] * correlation * SIGMAS


def test_the_jacobian_is_that_of_a_shift_a_turn_and_a_size():
    point, step = np.array([3.0, -2.0, 1.5]), 1e-6
    for k, column in enumerate(jacobian(point).T):
        error = np.zeros(7)
        error[k] = step
        after = np.exp(error[6]) * Rotation.from_rotvec(error[3:6]).apply(point) + error[:3]
        np.testing.assert_allclose((after - point) / step, column, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_a_shared_error_is_found_in_the_joint_covariance(seed):
    points, own, shared = drawn(seed)
    factor = jacobian(points) @ np.linalg.cholesky(shared)
    found = shared_covariance(points, own + factor @ np.swapaxes(factor, 1, 2), factor)
    np.testing.assert_allclose(found / np.outer(SIGMAS, SIGMAS), shared / np.outer(SIGMAS, SIGMAS), atol=1e-4)


def test_what_is_no_shared_error_stays_with_the_objects():
    points, own, _ = drawn(6)
    bend = np.random.default_rng(6).normal(0, 0.1, (len(points), 3, 2))
    covariance = own + bend @ np.swapaxes(bend, 1, 2)
    part = jacobian(points) @ root_of(shared_covariance(points, covariance, bend))
    left = covariance - part @ np.swapaxes(part, 1, 2)
    assert np.linalg.eigvalsh(left).min() > -1e-9  # No object has less than its part.
    assert np.trace(left, axis1=1, axis2=2).sum() > 0.2 * np.trace(covariance, axis1=1, axis2=2).sum()
    np.testing.assert_allclose(own_part(covariance, part), left, atol=1e-9)


def test_independent_objects_share_nothing():
    points, own, _ = drawn(7)
    found = shared_covariance(points, own, np.zeros((len(points), 3, 4)))
    np.testing.assert_allclose(found, 0, atol=1e-12)
    assert shared_covariance(points, own, np.zeros((len(points), 3, 0))) is None
    assert shared_covariance(points[:2], own[:2], np.ones((2, 3, 1))) is None


def test_in_another_frame_it_moves_the_same_objects():
    points, _, shared = drawn(8)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.3, -0.4, 1.2]).as_matrix(), [5.0, -3.0, 1.0]
    here, there = jacobian(points), jacobian(points @ pose[:3, :3].T + pose[:3, 3])
    expected = pose[:3, :3] @ here @ shared @ np.swapaxes(here, 1, 2) @ pose[:3, :3].T
    np.testing.assert_allclose(there @ moved(shared, pose) @ np.swapaxes(there, 1, 2), expected, atol=1e-12)
