"""Rotations against those of scipy, also near the half turn and near no turn."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from objslam.core.rotation import (
    cross,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_vector,
)


@pytest.fixture(params=[1e-12, 1e-5, 1e-4, 1e-3, 1.0, np.pi - 1e-6])
def vectors(request: pytest.FixtureRequest) -> np.ndarray:
    """300 vectors of one length, in all directions and along the axes."""
    directions = np.random.default_rng(0).standard_normal((300, 3))
    directions[:6] = np.vstack([np.eye(3), -np.eye(3)])
    return np.asarray(request.param * directions / np.linalg.norm(directions, axis=1, keepdims=True))


def test_a_vector_becomes_the_rotation_of_scipy(vectors):
    assert_allclose(rotation_from_vector(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=4e-16)


def test_a_rotation_has_the_vector_it_was_made_of(vectors):
    matrix = Rotation.from_rotvec(vectors).as_matrix()
    assert_allclose(rotation_vector(matrix), vectors, rtol=1e-7, atol=1e-15)
    assert_allclose(rotation_vector(matrix[0]), vectors[0], rtol=1e-7, atol=1e-15)


def test_half_turns_have_a_vector_along_their_axis():
    for axis in np.vstack([np.eye(3), [[0.6, 0.8, 0.0], [0.6, -0.8, 0.0]]]):
        half = 2 * np.outer(axis, axis) - np.eye(3)
        found = rotation_vector(half)
        assert_allclose(np.linalg.norm(found), np.pi)
        assert_allclose(np.abs(found @ axis), np.pi)


def test_quaternions_are_those_of_scipy():
    rotation = Rotation.random(1000, random_state=0)
    xyzw = rotation.as_quat(canonical=True)
    assert_allclose(quaternion_from_rotation(rotation.as_matrix()), xyzw, atol=1e-15)
    assert_allclose(rotation_from_quaternion(3 * xyzw), rotation.as_matrix(), atol=1e-15)
    assert_allclose(rotation_from_quaternion(-xyzw[0]), rotation.as_matrix()[0], atol=1e-15)


def test_quaternions_of_half_turns_are_as_scipy_writes_them():
    xyzw = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.6, -0.8, 0, 0], [0, 0.6, -0.8, 0]])
    assert_allclose(quaternion_from_rotation(Rotation.from_quat(-xyzw).as_matrix()), xyzw, atol=1e-15)


def test_a_rotation_about_z_stays_about_z():
    turn = rotation_from_vector(np.array([0.0, 0.0, 2.5]))
    assert (turn[2] == [0, 0, 1]).all()
    assert (turn[:, 2] == [0, 0, 1]).all()
    assert (rotation_vector(turn)[:2] == 0).all()


@pytest.mark.parametrize(("a", "b"), [((3,), (3,)), ((5, 3), (5, 3)), ((4, 5, 3), (3,)), ((0, 3), (0, 3))])
def test_cross_products_are_those_of_numpy(a, b):
    rng = np.random.default_rng(0)
    one, other = rng.standard_normal(a), rng.standard_normal(b)
    np.testing.assert_array_equal(cross(one, other), np.cross(one, other))
