"""Marginal covariances against dense linear algebra, and the way out when the graph leaves something open."""

import itertools

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.graph.factors.bearing import bearings
from objslam.graph.optimizers import build_graph
from objslam.graph.posterior import inverse as inverse_module
from objslam.graph.posterior.marginals import (
    SolvedGraph,
    correlated_factor,
    in_order,
    joint_covariances,
    largest_sigma,
    marginal_covariances,
    seen_covariances,
)
from objslam.graph.variables import L0, X0, make_values

POINTS = np.array([[4.0, 1, 0], [0, 5, 1], [-3, 2, 0.5]])
CAMERAS = np.tile(np.eye(4), (3, 1, 1))
CAMERAS[1:, :3, 3] = [[1.0, 0, 0], [0, 1.5, 0.2]]


def sightings(pairs, sigma=0.01):
    """Bearing factors for (camera, point) pairs without noise."""
    camera, point = np.array(pairs).T
    to = POINTS[point] - CAMERAS[camera, :3, 3]
    directions = to / np.linalg.norm(to, axis=1, keepdims=True)
    noise = [gtsam.noiseModel.Isotropic.Sigma(2, sigma)] * len(pairs)
    return bearings(camera, directions, point, noise)


def anchors(cameras, sigma=1e-3):
    return [
        gtsam.PriorFactorPose3((X0 + k), gtsam.Pose3(CAMERAS[k]), gtsam.noiseModel.Isotropic.Sigma(6, sigma))
        for k in cameras
    ]


def inverse_block(graph, values, landmark):
    """The block of the inverse of the whole information matrix."""
    keys = [(X0 + k) for k in range(3)] + [(L0 + j) for j in range(3)]
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    information = graph.linearize(values).hessian(ordering)[0]
    at = 18 + 3 * landmark
    return np.linalg.inv(information)[at : at + 3, at : at + 3]


def test_covariances_are_blocks_of_the_inverse_information():
    graph = build_graph(sightings([(k, j) for k in range(3) for j in range(3)]), anchors(range(3)))
    values, ledger = make_values(CAMERAS, POINTS, np.arange(3)), Ledger()
    covariance = marginal_covariances(SolvedGraph(graph, values), np.array([2, 0]), ledger)
    np.testing.assert_allclose(covariance[0], inverse_block(graph, values, 2), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(covariance[1], inverse_block(graph, values, 0), rtol=1e-6, atol=1e-12)
    assert not ledger.lines()


@pytest.mark.parametrize("dense", [2000, 12, 9, 0])
def test_the_normal_equations_give_what_gtsam_gives(dense, monkeypatch):
    """Also if only some of the landmarks, or none, are in the dense block of the last columns."""
    monkeypatch.setattr(inverse_module, "_DENSE", dense)
    graph = build_graph(sightings([(k, j) for k in range(3) for j in range(3)]), anchors(range(3)))
    values = make_values(CAMERAS, POINTS, np.arange(3))
    groups = [(L0 + 1,), (X0 + 2, L0 + 0), (L0 + 2,), (X0,)]
    marginals = gtsam.Marginals(graph, values)
    expected = [in_order(marginals.jointMarginalCovariance(list(keys)), keys) for keys in groups]
    found = joint_covariances(SolvedGraph(graph, values), groups)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[0], inverse_block(graph, values, 1), rtol=1e-6, atol=1e-12)
    floating = build_graph(sightings([(k, j) for k in range(3) for j in range(3)]))  # Nothing holds the frame.
    assert SolvedGraph(floating, values).inverse is None


def test_the_correlated_factor_is_the_joint_covariance():
    """Three landmarks have fewer coordinates than the factor has columns, so it is exact. Without a frame there is none."""
    pairs = [(k, j) for k in range(3) for j in range(3)]
    graph, values = build_graph(sightings(pairs), anchors(range(3), 0.05)), make_values(CAMERAS, POINTS, np.arange(3))
    (joint,) = joint_covariances(SolvedGraph(graph, values), [[L0 + 2, L0, L0 + 1]])
    blocks = np.array([joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(3)])
    factor = correlated_factor(SolvedGraph(graph, values), np.array([2, 0, 1]), blocks).reshape(9, -1)
    np.testing.assert_allclose(factor @ factor.T, joint, rtol=1e-6, atol=1e-12)
    assert not correlated_factor(SolvedGraph(build_graph(sightings(pairs)), values), np.array([2, 0, 1]), blocks).size


def test_the_correlated_factor_of_many_landmarks_keeps_their_correlations():
    """Forty landmarks seen from one camera whose pose is loose: six columns explain nearly all correlations."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(2, 9, 40), rng.uniform(-4, 4, 40), rng.uniform(0, 2, 40)])
    cameras = np.tile(np.eye(4), (4, 1, 1))
    cameras[:, :2, 3] = [[0.0, 0], [1, 1], [2, -1], [1, 0]]
    camera, point = (a.ravel() for a in np.meshgrid(np.arange(4), np.arange(40)))
    to = points[point] - cameras[camera, :3, 3]
    noise = [gtsam.noiseModel.Isotropic.Sigma(2, 0.003)] * len(to)
    held = [
        gtsam.PriorFactorPose3(X0 + k, gtsam.Pose3(cameras[k]), gtsam.noiseModel.Isotropic.Sigma(6, 0.03)) for k in range(4)
    ]
    graph = build_graph(bearings(camera, to / np.linalg.norm(to, axis=1, keepdims=True), point, noise), held)
    values = make_values(cameras, points, np.arange(40))
    (joint,) = joint_covariances(SolvedGraph(graph, values), [[L0 + j for j in range(40)]])
    blocks = np.array([joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(40)])
    factor = correlated_factor(SolvedGraph(graph, values), np.arange(40), blocks)
    left = joint - factor.reshape(120, -1) @ factor.reshape(120, -1).T
    assert factor.shape[2] < 40
    assert np.linalg.eigvalsh(left).min() > -1e-9 * np.linalg.eigvalsh(joint).max()  # Nowhere above the joint covariance.
    between = np.kron(np.eye(40), np.ones((3, 3))) == 0
    assert np.linalg.norm(left[between]) < 0.05 * np.linalg.norm(joint[between])


def test_a_landmark_that_one_ray_holds_is_left_out_and_the_others_are_not():
    pairs = [(k, j) for k in range(3) for j in range(2)]
    graph = build_graph(sightings([*pairs, (1, 2)]), anchors(range(3)))
    values, ledger = make_values(CAMERAS, POINTS, np.arange(3)), Ledger()
    covariance = marginal_covariances(SolvedGraph(graph, values), np.arange(3), ledger)
    assert np.isnan(covariance[2]).all()
    # the same graph with the loose landmark held: that changes nothing for the others, for nothing ties it to them
    sure = build_graph(sightings([*pairs, (1, 2)]), anchors(range(3)))
    sure.push_back(gtsam.PriorFactorPoint3((L0 + 2), POINTS[2], gtsam.noiseModel.Isotropic.Sigma(3, 1)))
    for j in range(2):
        np.testing.assert_allclose(covariance[j], inverse_block(sure, values, j), rtol=1e-4, atol=1e-9)
    assert len(ledger.warnings) == 1
    assert "l2" in ledger.warnings[0]
    assert "left unresolved" in ledger.warnings[0]


def test_where_nothing_says_where_the_cameras_are_no_landmark_has_a_covariance():
    graph = build_graph(sightings([(k, j) for k in range(3) for j in range(3)]))
    values, ledger = make_values(CAMERAS, POINTS, np.arange(3)), Ledger()
    covariance = marginal_covariances(SolvedGraph(graph, values), np.arange(3), ledger)
    assert np.isnan(covariance).all()
    assert "left unresolved" in ledger.lines()[0]


def test_a_camera_that_one_ray_holds_leaves_no_covariance_at_all():
    pairs = [(k, j) for k in range(2) for j in range(3)]
    graph = build_graph(sightings([*pairs, (2, 0)]), anchors(range(2)))  # landmarks can be held, camera 2 cannot
    values, ledger = make_values(CAMERAS, POINTS, np.arange(3)), Ledger()
    covariance = marginal_covariances(SolvedGraph(graph, values), np.arange(3), ledger)
    assert covariance.shape == (3, 3, 3)
    assert np.isnan(covariance).all()
    assert any("no object has a covariance" in warning for warning in ledger.warnings)


def test_no_landmarks():
    ledger = Ledger()
    values = make_values(CAMERAS, POINTS, np.zeros(0, dtype=np.int64))
    solved = SolvedGraph(build_graph(anchors(range(3))), values)
    covariance = marginal_covariances(solved, np.zeros(0, dtype=np.int64), ledger)
    assert covariance.shape == (0, 3, 3)
    assert not ledger.lines()


def test_seen_from_a_camera_the_covariance_is_that_of_a_map_that_begins_there():
    """Whichever camera the graph is anchored at, the shape of what it holds is the same."""
    rng = np.random.default_rng(3)
    turned = CAMERAS.copy()
    turned[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.3, size=(3, 3))).as_matrix()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.05, 0.2, 0.1, 0.05, 0.02]))
    steps = [
        gtsam.BetweenFactorPose3((X0 + k), (X0 + k + 1), gtsam.Pose3(inverse(a) @ b), noise)
        for k, (a, b) in enumerate(itertools.pairwise(turned))
    ]
    pairs = np.array([(k, j) for k in range(3) for j in range(3)])
    to = np.einsum("rji,rj->ri", turned[pairs[:, 0], :3, :3], POINTS[pairs[:, 1]] - turned[pairs[:, 0], :3, 3])
    unit = to / np.linalg.norm(to, axis=1, keepdims=True)
    rays = bearings(pairs[:, 0], unit, pairs[:, 1], [gtsam.noiseModel.Isotropic.Sigma(2, 0.02)] * len(pairs))
    values, ledger = make_values(turned, POINTS, np.arange(3)), Ledger()

    def anchored_at(k):
        anchor = gtsam.PriorFactorPose3((X0 + k), gtsam.Pose3(turned[k]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
        return SolvedGraph(build_graph(rays, steps, [anchor]), values)

    seen = seen_covariances(anchored_at(0), np.arange(3), np.array([2, 2, 2]), ledger)
    there = marginal_covariances(anchored_at(2), np.arange(3), ledger)
    turn = turned[2, :3, :3]
    np.testing.assert_allclose(turn @ seen @ turn.T, there, rtol=1e-4, atol=1e-8)
    assert (largest_sigma(seen) < largest_sigma(marginal_covariances(anchored_at(0), np.arange(3), ledger))).any()
    assert not ledger.lines()
