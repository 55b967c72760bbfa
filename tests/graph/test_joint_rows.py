"""The rows of a joint solve as arrays, and their normal equations: against GTSAM's own linearisation, and against numpy."""

from dataclasses import replace

import numpy as np
import pytest
from drives import drive_of
from numpy.testing import assert_allclose
from scipy import sparse

from objslam.config import Odometry, load_settings
from objslam.core.geometry import adjoint, exp_se3
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.factors.residual_algebra import whitening
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import make_values
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate


def by_gtsam(graph, values, rows, columns):
    """The whitened Jacobian (M, D) and the residuals (M,) of a GTSAM graph."""
    row, column, value = graph.linearize(values).sparseJacobian_()
    told = np.zeros((rows, columns + 1))
    told[row.astype(int) - 1, column.astype(int) - 1] = value
    return told[:, :-1], -told[:, -1]


@pytest.mark.parametrize("factor", ["bearing", "point_to_line"])
@pytest.mark.parametrize("localization", [None, PoseNoise()])
@pytest.mark.parametrize("aside", [False, True])
@pytest.mark.parametrize("loss", ["huber", "gnc"])
def test_the_rows_are_those_of_gtsam(factor, localization, aside, loss):
    """Far from the optimum, where robust weights count, with and without rays that begin beside the camera."""
    settings = load_settings(None, ("mode=joint", f"joint.factor={factor}"))
    changes = {
        "frames": 200,
        "objects": 8,
        "classes": 8,
        "localization": localization,
        "odometry": Odometry(),
        "depth": DepthNoise(),
    }
    made = drive_of(simulate(preset("demo", **changes), 3), settings)
    rng, used = np.random.default_rng(0), made.right()
    rays = made.rays
    if aside:
        offset = np.where(rng.random(len(rays))[:, None] < 0.5, rng.normal(scale=0.3, size=(len(rays), 3)), 0.0)
        rays = replace(rays, offset=offset)
    measured = Measurements.of(made.keyframes, rays, settings)
    poses = made.map_T_base @ made.keyframes.base_T_camera
    poses = poses @ exp_se3(rng.normal(scale=0.02, size=(len(poses), 6)))
    places = made.points + rng.normal(scale=0.1, size=made.points.shape)
    landmarks, which = np.arange(len(places)), np.flatnonzero(used)
    graph = build_graph(measured.factors(made.association.object, which, landmarks, made.points, loss))
    values = make_values(poses, places, landmarks)

    rows = JointGraph.of(measured, made.association, used, made.points, loss == "gnc").rows(poses, places)
    jacobian, residual = by_gtsam(graph, values, *rows.jacobian.shape)
    largest = np.abs(jacobian).max(axis=1, keepdims=True)
    # GTSAM's factors have sigmas of three digits, so that equal ones share a noise model.
    assert_allclose(rows.jacobian.toarray() / largest, jacobian / largest, atol=5e-3)
    assert_allclose(rows.residual, residual, atol=5e-3 * np.abs(residual).max())
    assert rows.cost == pytest.approx(graph.error(values), rel=2e-3)


def test_poses_that_are_hardly_known_beside_a_known_height_are_whitened():
    """A camera metres from the base mixes variances that differ by a factor of 4e10."""
    sigma = np.array([1e-3, 1e-3, 50.0, 200.0, 200.0, 1e-3])
    rng = np.random.default_rng(0)
    camera_T_base = exp_se3(np.hstack([rng.normal(scale=2.0, size=(200, 3)), rng.normal(scale=3.0, size=(200, 3))]))
    root = adjoint(camera_T_base) * sigma
    covariance = root @ np.swapaxes(root, 1, 2)
    whitened = whitening((covariance + np.swapaxes(covariance, 1, 2)) / 2)
    assert_allclose(np.tril(whitened, -1), 0.0, atol=0.0)
    turned = whitened @ root  # A whitened root is orthogonal.
    assert_allclose(turned @ np.swapaxes(turned, 1, 2), np.broadcast_to(np.eye(6), (200, 6, 6)), atol=1e-3)


def test_normal_equations_are_solved_in_any_order():
    rng = np.random.default_rng(1)
    jacobian = sparse.random_array((60, 18), density=0.3, rng=rng, format="csr")
    before, right = jacobian.toarray(), rng.normal(size=(18, 2))
    told = np.linalg.solve(before.T @ before, right)
    for order in (elimination_order(jacobian, np.repeat(np.arange(6), 3)), np.arange(18)[::-1]):
        assert sorted(order) == list(range(18))
        normal = NormalEquations.of(jacobian, order)
        assert_allclose(normal.solve(right), told)
        assert_allclose(normal.solve(right[:, 0]), told[:, 0])
    assert_allclose(jacobian.toarray(), before)


def test_the_columns_of_a_variable_are_eliminated_together_and_a_hub_last():
    """Variable 0 meets all others. Eliminated first, it would couple all of them."""
    blocks = np.repeat(np.arange(30), 2)
    rows = [(2 * k + i, i) for k in range(1, 30) for i in (0, 1)]
    row, column = np.repeat(np.arange(len(rows)), 2), np.ravel(rows)
    jacobian = sparse.csr_matrix((np.ones(len(row)), (row, column)), shape=(len(rows), len(blocks)))
    order = blocks[elimination_order(jacobian, blocks)]
    assert (order[::2] == order[1::2]).all()
    assert 0 in order[-4:]


def test_a_singular_system_is_an_error():
    jacobian = sparse.csr_matrix(np.array([[1.0, 1.0], [2.0, 2.0]]))
    with pytest.raises(SolveError, match="no single solution"):
        NormalEquations.of(jacobian, np.arange(2))
