"""The far side of objects that were seen with little parallax.

Rays from one stretch of the path measure the inverse of a depth (Civera, Davison and Montiel 2008). So an error of a ray to
one side moves an object far away, and the same error to the other side moves it only a little nearer. Wrong positions are
mostly too near, and near positions get a small covariance from the same noise of rays. The true position would then be far
outside the ellipsoid.
"""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.mapping.solution import Solution

_SIGMAS = 2.0
"""The distance of the far end from the mean, in standard deviations of the inverse depth. 2 is the reach of 95 % of a normal
distribution along one axis. A larger number widens more."""
_MOST = 0.4
"""The largest standard deviation, as a share of the depth, at which the far end counts. From 0.5 on, the far end is at
infinity. With a larger share, objects whose place the rays hardly determine become wider."""


def with_far_sides(solution: Solution) -> Solution:
    """Return the solution with covariances that reach to the far end of the depths that the rays allow.

    An object at the depth d has the standard deviation s along its mean ray. So its inverse depth 1 / d has the standard
    deviation s / d^2. At the far end of the depths, the inverse depth is smaller by `_SIGMAS` times that. This is the depth
    d / (1 - `_SIGMAS` s / d). For an ellipsoid that reaches there, s becomes s / (1 - `_SIGMAS` s / d).
    Objects with a measured range keep their covariance, because a range errs as much to both sides. Objects that were seen
    from many sides nearly keep it too, because their s is a small share of d.
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

    sigma: (N,) m, their standard deviations before. depth: (N,) m.
    """
    share = np.minimum(sigma / np.maximum(depth, 1e-9), _MOST)
    return np.asarray(sigma / (1 - _SIGMAS * share))
