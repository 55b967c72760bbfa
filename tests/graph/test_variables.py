"""Keyframes and landmarks are found by their symbols: other poses and points in a graph are none of them."""

import gtsam
import numpy as np
import pytest
from drives import ODOMETRY_ALONE, make_drive
from test_isam2 import grown

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3
from objslam.graph.assembly import Measurements
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.posterior.marginals import SolvedGraph, marginal_covariances, seen_covariances
from objslam.graph.variables import L0, landmarks_in, make_values, read_poses, with_points

OTHER_POSE, OTHER_POINT = gtsam.symbol("c", 3), gtsam.symbol("t", 0)
POSE, POINT = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([7.0, 8, 9])), np.array([-1.0, -2, -3])


def priors():
    """What holds the others where they are."""
    return [
        gtsam.PriorFactorPose3(OTHER_POSE, POSE, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)),
        gtsam.PriorFactorPoint3(OTHER_POINT, POINT, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)),
    ]


@pytest.mark.parametrize("insert_point", [gtsam.Values.insert, gtsam.Values.insertPoint3])
def test_other_poses_and_points_are_not_read(insert_point):
    rng = np.random.default_rng(0)
    poses, points, landmarks = exp_se3(rng.normal(size=(12, 6))), rng.normal(size=(30, 3)), np.array([1, 7, 29])
    values = make_values(poses, points, landmarks)
    values.insert(OTHER_POSE, POSE)
    insert_point(values, OTHER_POINT, POINT)
    np.testing.assert_allclose(read_poses(values), poses, atol=1e-15)
    np.testing.assert_array_equal(landmarks_in(values)[1], points[landmarks])
    np.testing.assert_array_equal(with_points(points, landmarks[1:], values), points)
    other = gtsam.Values()
    other.insert(OTHER_POSE, POSE)
    assert read_poses(other).shape == (0, 4, 4)
    assert landmarks_in(other)[1].shape == (0, 3)


def test_a_solve_and_its_marginals_with_others_are_those_without(drive):
    measured, owner = Measurements.of(drive.keyframes, drive.rays, drive.settings), drive.association.object
    landmarks = np.arange(len(drive.points))
    made = measured.factors(owner, np.flatnonzero(drive.right()), landmarks, drive.points)
    found = []
    for others in (False, True):
        graph, values = build_graph(made), make_values(drive.keyframes.map_T_camera, drive.points, landmarks)
        if others:
            for factor in priors():
                graph.push_back(factor)
            values.insert(OTHER_POSE, POSE)
            values.insert(OTHER_POINT, POINT)
        values = levenberg_marquardt(graph, values, 30).values
        covariance = marginal_covariances(SolvedGraph(graph, values), landmarks, Ledger())
        seen = seen_covariances(SolvedGraph(graph, values), landmarks, np.full(len(landmarks), 5), Ledger())
        found.append((read_poses(values), with_points(drive.points, landmarks, values), covariance, seen))
    for without, beside in zip(*found, strict=True):
        np.testing.assert_allclose(beside, without, rtol=1e-4, atol=1e-6)


@pytest.fixture(scope="module")
def drive():
    return make_drive(0, "mode=joint", frames=150, false=0.0, **ODOMETRY_ALONE)


@pytest.mark.parametrize("slices", [False, True])
def test_a_live_graph_keeps_others_apart(drive, slices, monkeypatch):
    """Added while it grows, updated, relinearised, rebuilt at once and in slices, solved, saved and restored."""
    monkeypatch.setattr("objslam.graph.isam2._AT_ONCE", 50 if slices else 1000)
    graph, landmarks = grown(drive)
    every = np.arange(len(drive.keyframes))
    graph.refresh()
    poses, points, size = graph.poses(every), graph.points(landmarks), graph._store.graph().size()
    graph.add_variable(OTHER_POSE, gtsam.Pose3())
    graph.add_variable(OTHER_POINT, np.zeros(3))
    graph.add("calibration", [0, 1], [[factor] for factor in priors()])
    distance, noise = float(np.linalg.norm(points[0] - POINT)), gtsam.noiseModel.Isotropic.Sigma(1, 0.5)
    graph.add("distance", [0], [[gtsam.RangeFactor3(OTHER_POINT, L0 + int(landmarks[0]), distance, noise)]])

    def unchanged():
        graph.refresh()
        np.testing.assert_allclose(graph.poses(every), poses, atol=0.02)
        np.testing.assert_allclose(graph.points(landmarks), points, atol=0.02)
        np.testing.assert_allclose(graph.variable(OTHER_POSE).matrix(), POSE.matrix(), atol=1e-3)
        np.testing.assert_allclose(graph.variable(OTHER_POINT), POINT, atol=1e-2)
        assert graph.rebuilds == 0
        assert graph._isam.getFactorsUnsafe().size() == size + 3

    graph.update()
    for _ in range(4):
        graph.prepare(landmarks, relinearise=True)
    unchanged()
    saved = graph.save()
    graph.solve(20)
    unchanged()
    graph.rebuild_in_slices(every)
    assert graph.is_rebuilding == slices
    while graph.is_rebuilding:
        graph.continue_rebuild()
    unchanged()
    graph.drop_landmarks(landmarks[:1])
    graph.rebuild()
    assert not graph._store.kinds["distance"]  # it was about this landmark
    graph.restore(saved)
    unchanged()
    assert graph.before(5) == 4
