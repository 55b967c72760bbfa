"""RANSAC triangulation of one object for a session, as `triangulation` is for a whole log.

Both take a consensus of ray pairs. This one is in numpy, because a frame has no time for a call of torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.association.refinement import information, normalised_residuals, refine
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import widest_angle
from objslam.core.statistics import OUTLIER_RAY

_MOST_PAIRS = 300  # The most pairs of rays that are tried; larger costs time.
_MOST_RAYS = 60  # The most rays that pairs are taken from, and the parallax.
_MIN_ANGLE = np.radians(1.0)  # The least angle (rad) of two rays that make a pair.
_FREE_INFORMATION = 1e-4  # The information (m^-2) added to each axis: what rays do not fix is known to 100 m.


@dataclass(frozen=True)
class PointFit:
    """position: (3,) m. covariance: (3, 3) m^2. parallax: rad, of the inlier rays. inlier: (R,) which rays agree."""

    position: Floats
    covariance: Floats
    parallax: float
    inlier: Bools


def fit_point(obs: Observations, rng: np.random.Generator, slack: float = 0.0) -> PointFit | None:
    """The point on which most rays agree; None where no two do. slack: m, a standard deviation of the origins."""
    start = _consensus(obs, rng, slack)
    if start is None:
        return None
    inlier = normalised_residuals(obs, start, slack) < OUTLIER_RAY
    for _ in range(2):
        if inlier.sum() < 2:
            return None
        held, before = np.flatnonzero(inlier), inlier
        start = refine(obs, held, np.zeros(len(held), dtype=np.int64), start[None], np.ones(1))[0]
        inlier = normalised_residuals(obs, start, slack) < OUTLIER_RAY
        if (inlier == before).all():
            break
    if inlier.sum() < 2:
        return None
    held = np.flatnonzero(inlier)
    some = held[np.linspace(0, len(held) - 1, min(len(held), _MOST_RAYS)).astype(np.int64)]
    inner = obs.take(held)
    covariance = np.linalg.inv(information(inner, start).sum(axis=0) + _FREE_INFORMATION * np.eye(3))
    off = normalised_residuals(inner, start, slack)
    covariance *= max(1.0, float(np.mean(off**2)) / 2)
    return PointFit(start, covariance, widest_angle(obs.direction[some]), inlier)


def _consensus(obs: Observations, rng: np.random.Generator, slack: float) -> Floats | None:
    """Of the points where two rays meet or a range ends, the one on which most rays agree."""
    count = len(obs)
    some = np.arange(count) if count <= _MOST_RAYS else np.sort(rng.permutation(count)[:_MOST_RAYS])
    a, b = (some[i] for i in np.triu_indices(len(some), 1))
    if len(a) > _MOST_PAIRS:
        pick = rng.permutation(len(a))[:_MOST_PAIRS]
        a, b = a[pick], b[pick]
    points = [_midpoints(obs, a, b)]
    ranged = some[np.isfinite(obs.range[some])]
    points.append(obs.origin[ranged] + obs.range[ranged, None] * obs.direction[ranged])
    tried = np.concatenate(points)
    if not len(tried):
        return None
    # the residuals of `refinement`, written out for every point and every ray at once
    to = tried[:, None] - obs.origin  # (H, R, 3)
    depth = np.einsum("hri,ri->hr", to, obs.direction)
    distance2 = np.einsum("hri,hri->hr", to, to)
    off2 = np.maximum(distance2 - depth**2, 0.0) / (obs.sigma**2 * distance2 + slack**2 + 1e-18)
    cost = np.where(depth > MIN_DEPTH, np.minimum(off2, OUTLIER_RAY**2), OUTLIER_RAY**2)
    with np.errstate(invalid="ignore"):
        wrong = ((np.sqrt(distance2) - obs.range) / obs.range_sigma) ** 2
    cost = cost + np.where(np.isfinite(wrong), np.minimum(wrong, OUTLIER_RAY**2) / 2, 0.0)
    return np.asarray(tried[cost.sum(axis=1).argmin()])


def _midpoints(obs: Observations, a: Ints, b: Ints) -> Floats:
    """Where pairs of rays (P,) come closest, without those that are nearly parallel or do so behind a camera."""
    along_one, along_other, middle, _, sin2 = closest_approach(obs, a, b)
    return middle[(sin2 > np.sin(_MIN_ANGLE) ** 2) & (along_one > MIN_DEPTH) & (along_other > MIN_DEPTH)]
