"""The rules for data from outside, against numbers that are known to be right or wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial.transform import Rotation

from objslam.core.geometry import make_pose
from objslam.core.validity import covariance_fault, rigid_pose, rigid_poses, valid_pose_rows

TURN = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()


def test_a_rotation_that_was_rounded_becomes_the_nearest_exact_one():
    noise = 1e-4 * np.random.default_rng(0).uniform(-1, 1, (3, 3))
    found = rigid_pose(make_pose(TURN + noise, np.array([1.0, 2.0, 3.0])))
    assert found is not None
    turn = found[:3, :3]
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-15)
    oracle = Rotation.from_matrix(TURN + noise).as_matrix()  # scipy orthonormalises too
    np.testing.assert_allclose(turn, oracle, atol=1e-7)
    np.testing.assert_array_equal(found[:3, 3], [1, 2, 3])


def test_an_exact_pose_stays_bit_by_bit():
    pose = make_pose(TURN, np.array([9.9e6, -9.9e6, 0.1]))
    np.testing.assert_array_equal(rigid_pose(pose), pose)


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(0, 3, 1e7), (0, 3, np.nan), (2, 3, -np.inf), (0, 0, np.nan), (1, 1, np.inf), (0, 0, -1.0), (0, 1, 0.01), (3, 0, 1.0)],
)
def test_what_is_no_pose(row, column, value):
    pose = np.eye(4)
    pose[row, column] = value
    assert rigid_pose(pose) is None
    both, good = rigid_poses(np.stack([pose, np.eye(4)]))
    assert good.tolist() == [False, True]
    np.testing.assert_array_equal(both, [np.eye(4), np.eye(4)])


@given(npst.arrays(np.float64, (3, 4, 4), elements=st.floats()))
def test_no_array_is_rigid_that_is_no_rotation(poses):
    exact, _ = rigid_poses(poses)
    np.testing.assert_allclose(
        np.swapaxes(exact[:, :3, :3], 1, 2) @ exact[:, :3, :3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-9
    )
    assert np.abs(exact[:, :3, 3]).max() < 1e7


@given(
    npst.arrays(np.float64, 3, elements=st.floats(-3, 3)),
    st.sampled_from([0.0, 1e-15, 1e-13, 1e-9, 1e-4, 1e-2]),
    st.sampled_from(
        [(0, 0, 1.0), (0, 0, -1.0), (3, 3, 2.0), (3, 0, 1.0), (1, 3, 1e7), (1, 3, -1e7), (1, 3, np.nan), (2, 2, np.nan)]
    ),
    st.integers(0, 99),
)
def test_one_pose_is_judged_as_many_are(vector, noise, change, seed):
    row, column, factor = change
    pose = make_pose(Rotation.from_rotvec(vector).as_matrix(), np.array([1.0, 2.0, 3.0]))
    pose[:3, :3] += noise * np.random.default_rng(seed).uniform(-1, 1, (3, 3))
    pose[row, column] = pose[row, column] * factor if pose[row, column] else factor
    (expected,), (good,) = rigid_poses(pose[None])
    found = rigid_pose(pose)
    assert (found is not None) == good
    if found is not None:
        np.testing.assert_array_equal(found, expected)
        assert not np.shares_memory(found, pose)


def test_rows_that_are_no_poses():
    rows = np.tile([1.0, 2, 3, 0, 0, 0, 1], (6, 1))
    rows[1, 0], rows[2, 6], rows[3, 6], rows[4, 3], rows[5, 2] = np.inf, 0.0, 1e-7, np.nan, -1e7
    assert valid_pose_rows(rows).tolist() == [True] + 5 * [False]


@given(npst.arrays(np.float64, (4, 3, 3), elements=st.floats(-1e3, 1e3)), st.sampled_from([1e-6, 1.0, 1e6]))
def test_a_product_with_its_transpose_is_a_covariance(roots, scale):
    units = np.diag([1.0, scale, scale**2])
    assert covariance_fault(units @ (roots @ np.swapaxes(roots, 1, 2)) @ units) is None


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.diag([1.0, np.inf]), "not finite"),
        (np.diag([1.0, -1e-9]), "negative variance"),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), "not symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "correlation"),
        (np.array([[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]), "negative in some direction"),
        (np.array([[0.0, 1.0], [1.0, 1.0]]), None),
    ],
)
def test_what_is_no_covariance(matrix, fault):
    found = covariance_fault(matrix)
    assert found is not None
    assert fault is None or fault in found
