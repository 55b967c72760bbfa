"""A solve on arrays from near the optimum, against Levenberg-Marquardt of GTSAM on the graph of factors."""

import numpy as np
import pytest
from drives import ODOMETRY_ALONE, make_drive

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3
from objslam.graph.assembly import Measurements
from objslam.graph.least_squares.gauss_newton import gauss_newton
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order
from objslam.graph.optimizers import levenberg_marquardt
from objslam.graph.outlier_rejection import reject_outliers
from objslam.graph.posterior.marginals import SolvedGraph, SolvedMeasurements, marginal_covariances, seen_covariances
from objslam.graph.variables import landmarks_in, read_poses


@pytest.fixture(scope="module")
def solved():
    """A drive, its measurements, its inliers, and GTSAM's optimum: poses, points and cost."""
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    measured, used = Measurements.of(drive.keyframes, drive.rays, drive.settings), drive.right()
    poses = drive.map_T_base @ drive.keyframes.base_T_camera
    graph, values = measured.whole(drive.association.object, used, poses, drive.points)
    found = levenberg_marquardt(graph, values, 100, 1e-14)
    return drive, measured, used, read_poses(found.values), landmarks_in(found.values)[1], found.cost_after


def nearby(solved, scale):
    """The graph with other places, other poses, and the normal equations there."""
    drive, measured, used, poses, _, _ = solved
    graph, rng = JointGraph.of(measured, drive.association, used, drive.points), np.random.default_rng(0)
    other = poses @ exp_se3(rng.normal(scale=scale, size=(len(poses), 6)))
    jacobian = graph.rows(other, graph.weak + rng.normal(scale=scale, size=graph.weak.shape)).jacobian
    return graph, other, NormalEquations.of(jacobian, elimination_order(jacobian, graph.blocks))


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("scale", [1e-3, 0.02])
def test_it_ends_at_the_optimum_of_gtsam(solved, scale, given):
    """Also with the normal equations of values at which the robust weights are quite different, and without any."""
    graph, other, normal = nearby(solved, scale)
    seen = []
    found = gauss_newton(graph, other, normal if given else None, 100, 0.0, 1e-9, lambda cost, *_: seen.append(cost))
    assert found.ended
    assert found.steps == len(seen)
    assert (np.diff([found.cost_before, *seen]) <= 0).all()
    assert found.cost_after == pytest.approx(solved[-1], rel=2e-3)  # GTSAM's sigmas have three digits
    assert np.abs(found.landmarks - solved[-2]).max() < 2e-3
    assert np.linalg.norm((found.map_T_camera - solved[3])[:, :3, 3], axis=1).max() < 2e-3


def test_few_steps_do_not_end(solved):
    graph, other, normal = nearby(solved, 0.02)
    found = gauss_newton(graph, other, normal, 1, 0.0, 1e-9)
    assert not found.ended
    assert found.steps == 1
    assert found.cost_after < found.cost_before


@pytest.mark.parametrize("wrong", [1.0, 1e-9, None])
def test_outliers_are_rejected_as_by_gtsam(solved, wrong):
    """Normal equations that promise far too long steps do no harm: the solve makes its own. So it does without any."""
    drive, measured, used, poses, points, _ = solved
    nothing, near = np.zeros(len(used), dtype=bool), None
    if wrong is not None:
        graph = JointGraph.of(measured, drive.association, used, points)
        jacobian = graph.rows(poses, points).jacobian
        near = graph.landmarks, NormalEquations.of(wrong * jacobian, elimination_order(jacobian, graph.blocks))
    start = measured, drive.association, poses, points, used, nothing, None
    ours, theirs = reject_outliers(*start, near=near, close=True), reject_outliers(*start, rounds=1)
    np.testing.assert_array_equal(ours.used, theirs.used)
    assert np.abs(ours.positions - theirs.positions).max() < 2e-3
    assert ours.near is not None
    assert theirs.near is None  # One solve, by GTSAM.
    np.testing.assert_allclose(read_poses(theirs.optimum.values), theirs.map_T_camera, atol=1e-9)
    np.testing.assert_allclose(landmarks_in(theirs.optimum.values)[1], theirs.positions, atol=1e-9)


def test_covariances_are_those_of_gtsam(solved):
    drive, measured, used, poses, points, _ = solved
    landmarks, ledger = np.arange(len(points)), Ledger()
    ours = SolvedMeasurements(measured, drive.association, used, poses, points)
    theirs = SolvedGraph(*measured.whole(drive.association.object, used, poses, points, "gnc"))
    covariance, expected = (marginal_covariances(one, landmarks, ledger) for one in (ours, theirs))
    size = np.linalg.norm(expected, axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(covariance / size, expected / size, atol=5e-3)  # GTSAM's sigmas have three digits.
    last = np.full(len(points), len(poses) - 1)
    seen, told = (seen_covariances(one, landmarks, last, ledger) for one in (ours, theirs))
    size = np.linalg.norm(told, axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(seen / size, told / size, atol=5e-3)
    assert not ledger.lines()
