"""Triangulate one object of a live session by RANSAC, from pairs of rays.

The folder `triangulation` does this for all objects of a log. The calls of torch in it take too long for one frame.
"""

from dataclasses import dataclass

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.association.refinement import information, normalised_residuals, refine
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import widest_angle
from objslam.core.statistics import OUTLIER_RAY

_MOST_PAIRS = 300  # The most ray pairs that are tried. A larger value costs time.
_MOST_RAYS = 60  # The most rays from which pairs and the parallax are taken. A larger number costs time.
_MIN_ANGLE = np.radians(1.0)
"""The least angle (rad) between the two rays of a pair. A larger angle needs more parallax for a point."""
_FREE_INFORMATION = 1e-4  # The information (m^-2) added to each axis: a prior of 100 m, for directions that no ray fixes.


@dataclass(frozen=True)
class PointFit:
    """One fitted point. position: (3,) m. covariance: (3, 3) m^2. parallax: rad, the widest angle between the inliers.
    inlier: (R,) whether each ray is an inlier."""

    position: Floats
    covariance: Floats
    parallax: float
    inlier: Bools


def fit_point(obs: Observations, rng: np.random.Generator, slack: float = 0.0) -> PointFit | None:
    """Fit the point on which most rays agree. Return None if no two rays agree. slack: m, the standard deviation of the
    origins."""
    start = _consensus(obs, rng, slack)
    if start is None:
        return None
    inlier = normalised_residuals(obs, start, slack) < OUTLIER_RAY
    for _ in range(2):
        held, before = np.flatnonzero(inlier), inlier
        if len(held) < 2:
            return None
        start = refine(obs, held, np.zeros(len(held), dtype=np.int64), start[None], np.ones(1))[0]
        inlier = normalised_residuals(obs, start, slack) < OUTLIER_RAY
        if (inlier == before).all():
            break
    held = np.flatnonzero(inlier)
    if len(held) < 2:
        return None
    some = held[np.linspace(0, len(held) - 1, min(len(held), _MOST_RAYS)).astype(np.int64)]
    inner = obs.take(held)
    covariance = np.linalg.inv(information(inner, start).sum(axis=0) + _FREE_INFORMATION * np.eye(3))
    covariance *= max(1.0, float(np.mean(normalised_residuals(inner, start, slack) ** 2)) / 2)
    return PointFit(start, covariance, widest_angle(obs.direction[some]), inlier)


def _consensus(obs: Observations, rng: np.random.Generator, slack: float) -> Floats | None:
    """Return the point (3,) with the least robust cost: the midpoint of two rays, or the end of a range. None if no such
    point exists."""
    count = len(obs)
    some = np.arange(count) if count <= _MOST_RAYS else np.sort(rng.permutation(count)[:_MOST_RAYS])
    a, b = (some[i] for i in np.triu_indices(len(some), 1))
    if len(a) > _MOST_PAIRS:
        pick = rng.permutation(len(a))[:_MOST_PAIRS]
        a, b = a[pick], b[pick]
    along_a, along_b, middle, _, sin2 = closest_approach(obs, a, b)
    middle = middle[(sin2 > np.sin(_MIN_ANGLE) ** 2) & (along_a > MIN_DEPTH) & (along_b > MIN_DEPTH)]
    ranged = some[np.isfinite(obs.range[some])]
    tried = np.concatenate([middle, obs.origin[ranged] + obs.range[ranged, None] * obs.direction[ranged]])
    if not len(tried):
        return None
    # Residuals as in `refinement`, but for all points and rays at once.
    to = tried[:, None] - obs.origin  # (H, R, 3)
    depth = np.einsum("hri,ri->hr", to, obs.direction)
    distance2 = np.einsum("hri,hri->hr", to, to)
    off2 = np.maximum(distance2 - depth**2, 0.0) / (obs.sigma**2 * distance2 + slack**2 + 1e-18)
    cost = np.where(depth > MIN_DEPTH, np.minimum(off2, OUTLIER_RAY**2), OUTLIER_RAY**2)
    with np.errstate(invalid="ignore"):
        wrong = ((np.sqrt(distance2) - obs.range) / obs.range_sigma) ** 2
    cost = cost + np.where(np.isfinite(wrong), np.minimum(wrong, OUTLIER_RAY**2) / 2, 0.0)
    return np.asarray(tried[cost.sum(axis=1).argmin()])
