"""Points that are refined by their rays, and the small systems of the steps."""

import numpy as np
import pytest

from objslam.association.observations import Observations
from objslam.association.refinement import _DAMPING, _FIRST, _SECOND, _solve_symmetric, refine


@pytest.mark.parametrize("spread", [1.0, 1e-2, 1e-5])
def test_the_systems_of_nearly_parallel_rays_are_solved(spread):
    """The direction along such rays is known by the damping alone."""
    rng, number = np.random.default_rng(0), 200
    away = np.array([1.0, 0.0, 0.0]) + spread * rng.standard_normal((number, 30, 3))
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    matrices = (np.eye(3) - away[..., :, None] * away[..., None, :]).sum(axis=1)
    matrices += (_DAMPING * np.trace(matrices, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    right = rng.standard_normal((number, 3))
    found = _solve_symmetric(matrices[:, _FIRST, _SECOND].T, right.T).T
    np.testing.assert_allclose(found, np.linalg.solve(matrices, right[..., None])[..., 0], rtol=1e-7)


def test_points_move_to_where_their_rays_meet_and_others_stay():
    rng, count, views = np.random.default_rng(1), 20, 15
    points = rng.uniform(-5, 5, (count, 3))
    index = np.repeat(np.arange(count), views)
    origin = rng.uniform(-5, 5, (len(index), 3))
    direction = points[index] - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    none = np.full(len(index), np.nan)
    rays = Observations.of_lines(origin, direction, np.full(len(index), 0.01), none, none)
    start = np.concatenate([points + 0.1 * rng.standard_normal((count, 3)), [[1.0, 2.0, 3.0]]])  # The last has no rays.
    found = refine(rays, np.arange(len(index)), index, start, np.ones(count + 1))
    np.testing.assert_allclose(found[:count], points, atol=1e-4)
    np.testing.assert_array_equal(found[count], start[count])
