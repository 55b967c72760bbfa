"""Widen the covariances of objects that were seen with little parallax, so that they reach to the far side.

Rays from one stretch of the path measure the inverse of a depth (Civera, Davison and Montiel 2008). If a ray errs to one
side, the object moves far away. If it errs as much to the other side, the object moves only a little nearer. Wrong positions
are mostly too near. At a near position, the same noise of rays gives a small covariance. The true position would then be far
outside the ellipsoid."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.mapping.solution import Solution

_SIGMAS = 2.0
"""The number of standard deviations of the inverse depth from the mean to the far end. Within 2 standard deviations lie 95 %
of a normal distribution. With a larger number, covariances become wider."""
_MOST = 0.4
"""The limit of the standard deviation, as a share of the depth, in the computation of the far end. From 0.5 on, the far end
would be at infinity. With a larger limit, objects whose place the rays hardly determine become wider."""


def with_far_sides(solution: Solution) -> Solution:
    """Return the solution with covariances that reach to the far end of the depths that the rays allow.

    An object at the depth d has the standard deviation s along its mean ray. So its inverse depth 1 / d has the standard
    deviation s / d^2. At the far end, the inverse depth is smaller by `_SIGMAS` times s / d^2, so the depth is d / (1 -
    `_SIGMAS` s / d). For an ellipsoid that reaches to the far end, s becomes s / (1 - `_SIGMAS` s / d). Objects with a
    measured range keep their covariance, because a range errs as much to both sides. The covariance of objects that were
    seen from many sides hardly changes, because their s is a small share of d.
    """
    rays, estimate = solution.rays, solution.estimate
    index, covariance = solution.association.object, estimate.covariance
    used = np.flatnonzero((estimate.weight > 0) & (index >= 0))
    origin, direction = (values[used] for values in rays.in_map(solution.keyframes.map_T_camera))
    owner, count = index[used], len(covariance)
    number = np.bincount(owner, minlength=count)
    ranged = np.bincount(owner, np.isfinite(rays.range[used]), count) > 0
    whole = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)) & (number > 0) & ~ranged)
    mean = np.column_stack([np.bincount(owner, column, count) for column in direction.T])[whole]
    ahead = mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    away = np.linalg.norm(estimate.positions[owner] - origin, axis=1)
    depth = np.bincount(owner, away, count)[whole] / number[whole]
    sigma = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", ahead, covariance[whole], ahead), 0.0))
    wider = covariance.copy()
    more = far_sigma(sigma, depth) ** 2 - sigma**2
    wider[whole] += more[:, None, None] * ahead[:, :, None] * ahead[:, None, :]
    return replace(solution, estimate=replace(estimate, covariance=wider))


def far_sigma(sigma: Floats, depth: Floats) -> Floats:
    """Return the standard deviations (N,), m, of ellipsoids that reach to the far end of their depths.

    sigma: (N,) m, the standard deviations before, along the mean ray. depth: (N,) m, the depths of the objects.
    """
    share = np.minimum(sigma / np.maximum(depth, 1e-9), _MOST)
    return np.asarray(sigma / (1 - _SIGMAS * share))
