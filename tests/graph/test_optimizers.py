"""The optimisers against closed forms, and what GTSAM throws as errors that say what to do."""

import gc
import weakref

import gtsam
import numpy as np
import pytest

from objslam.core.geometry import exp_se3
from objslam.errors import SolveError
from objslam.graph.factors.bearing import bearings
from objslam.graph.optimizers import build_graph, graduated, indeterminate, levenberg_marquardt
from objslam.graph.variables import L0, X0, landmarks_in, make_values, read_poses

NO_POSES = np.zeros((0, 4, 4))


def priors(points, sigmas, landmark):
    """Prior factors that measure L(landmark) at the points (n, 3)."""
    return [
        gtsam.PriorFactorPoint3((L0 + j), point, gtsam.noiseModel.Isotropic.Sigma(3, sigma))
        for point, sigma, j in zip(points, sigmas, landmark, strict=True)
    ]


def test_values_are_read_back_in_the_order_of_their_keys():
    rng = np.random.default_rng(0)
    poses, points = exp_se3(rng.normal(size=(12, 6))), rng.normal(size=(300, 3))
    landmarks = np.array([1, 7, 12, 299])
    values = make_values(poses, points, landmarks)
    np.testing.assert_allclose(read_poses(values), poses, atol=1e-15)
    np.testing.assert_array_equal(landmarks_in(values)[1], points[landmarks])
    empty = make_values(NO_POSES, points, landmarks[:0])
    assert read_poses(empty).shape == (0, 4, 4)
    assert landmarks_in(empty)[1].shape == (0, 3)


def test_a_solve_with_a_record_of_its_iterations_is_freed():
    """GTSAM keeps the function that it calls after each iteration. A run makes dozens of such solves."""

    class Record:
        def __call__(self, cost, values):
            self.cost = cost

    record = Record()
    freed = weakref.ref(record)
    graph = build_graph(priors(np.eye(3), np.ones(3), np.zeros(3, dtype=int)))
    levenberg_marquardt(graph, make_values(NO_POSES, np.ones((1, 3)), np.array([0])), 10, 1e-9, record)
    assert record.cost < 2
    del record
    gc.collect()
    assert freed() is None


def test_levenberg_marquardt_finds_the_weighted_mean():
    rng = np.random.default_rng(1)
    points, sigmas, landmark = rng.normal(size=(20, 3)), rng.uniform(0.1, 2, 20), np.arange(20) % 2
    graph = build_graph(priors(points[:5], sigmas[:5], landmark[:5]), priors(points[5:], sigmas[5:], landmark[5:]))
    assert graph.size() == 20
    optimum = levenberg_marquardt(graph, make_values(NO_POSES, np.full((2, 3), 9.0), np.arange(2)), 50)
    weights = sigmas**-2
    for j in range(2):
        mine = landmark == j
        mean = np.average(points[mine], axis=0, weights=weights[mine])
        np.testing.assert_allclose(landmarks_in(optimum.values)[1][j], mean, atol=1e-9)
    mean = landmarks_in(optimum.values)[1][landmark]
    cost = 0.5 * (((points - mean) / sigmas[:, None]) ** 2).sum()
    assert optimum.cost_after == pytest.approx(cost)
    assert optimum.cost_before == pytest.approx(0.5 * (((points - 9) / sigmas[:, None]) ** 2).sum())
    assert optimum.iterations >= 1
    assert optimum.weights is None


def test_graduated_rejects_what_does_not_agree():
    rng = np.random.default_rng(2)
    points = rng.normal(np.array([1.0, 2, 3]), 0.01, size=(20, 3))
    points[12:] = rng.uniform(-5, 5, size=(8, 3))
    graph = build_graph(priors(points, np.full(20, 0.01), [0] * 20))
    optimum = graduated(graph, make_values(NO_POSES, np.zeros((1, 3)), np.arange(1)), 50, [])
    np.testing.assert_allclose(optimum.weights[:12], 1, atol=1e-3)
    np.testing.assert_allclose(optimum.weights[12:], 0, atol=1e-3)
    np.testing.assert_allclose(landmarks_in(optimum.values)[1][0], points[:12].mean(axis=0), atol=1e-4)
    assert optimum.cost_after < optimum.cost_before


def test_graduated_never_rejects_known_inliers():
    graph = build_graph(priors(np.array([[0.0, 0, 0], [0, 0, 0.01], [0, 0, 8.0]]), [0.01, 0.01, 0.01], [0, 0, 0]))
    optimum = graduated(graph, make_values(NO_POSES, np.zeros((1, 3)), np.arange(1)), 50, [2])
    assert optimum.weights[2] == 1
    assert landmarks_in(optimum.values)[1][0, 2] == pytest.approx(8, abs=0.01)


@pytest.mark.parametrize("solve", [levenberg_marquardt, lambda *args: graduated(*args, [])])
def test_what_gtsam_throws_is_a_solve_error(solve):
    graph = build_graph(priors(np.zeros((2, 3)), [1, 1], [0, 1]))
    with pytest.raises(SolveError, match=r"no single solution: .*l1"):
        solve(graph, make_values(NO_POSES, np.zeros((1, 3)), np.arange(1)), 10)
    with pytest.raises(SolveError, match="not finite"):
        solve(graph, make_values(NO_POSES, np.array([[np.nan, 0, 0], [0, 0, 0]]), np.arange(2)), 10)


def test_an_indeterminate_system_names_its_variable():
    """Not made up: what GTSAM throws for a point that a single bearing holds."""
    noise = [gtsam.noiseModel.Isotropic.Sigma(2, 0.01)]
    graph = build_graph(
        bearings(np.array([0]), np.array([[1.0, 0, 0]]), np.array([5]), noise),
        [gtsam.PriorFactorPose3((X0 + 0), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))],
    )
    values = make_values(np.eye(4)[None], np.full((6, 3), 1.0), np.array([5]))
    with pytest.raises(RuntimeError) as thrown:
        gtsam.Marginals(graph, values)
    text = str(indeterminate(thrown.value))
    assert "l5" in text
    assert "joint.prior_sigma" in text
    assert "\n" not in text
