"""Find where the thing of a bundle of rays can be, from the bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.crossings.bundles import Bundles
from objslam.association.observations import MIN_DEPTH
from objslam.association.refinement import refine, variance
from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import grouped_sums

_STEPS = 48
"""The number of distances that are tried for a bundle, evenly in ln distance. A larger number is more exact, and slower."""
_FEW_STEPS = 8
"""The number of distances that are tried for the start of a fit of one point to a bundle. Bundles without parallax fit at
many distances. A larger number is more exact, and slower."""
_NEAREST, _FURTHEST = 0.03, 2.0
"""The least and the greatest distance that are tried for a bundle, as multiples of the usual distance of its class. A wider
range tries more places, farther apart."""


@dataclass(frozen=True)
class FreeFit:
    """Points that fit the bearings of G bundles best, at any distance. position: (G, 3) m. log_volume: (G,) ln of the
    volume, m^3, of each position, as in `fit_points`. along: (G,) m, the largest standard deviation of each position over
    all directions.
    """

    position: Floats
    log_volume: Floats
    along: Floats

    def take(self, which: Ints) -> FreeFit:
        """Return the points `which`."""
        return FreeFit(self.position[which], self.log_volume[which], self.along[which])


def fit_freely(bundles: Bundles) -> tuple[FreeFit, Floats]:
    """Return the points that fit the bearings of each bundle best, and their costs (G,)."""
    tried = np.stack(points_along(bundles, _FEW_STEPS))
    cost = np.stack([bundles.bearing_cost(points) for points in tried])
    start = tried[cost.argmin(axis=0), np.arange(bundles.count)]
    free = FreeFit(*fit_points(bundles, bundles.group, bundles.landmark, bundles.noise, start))
    return free, np.minimum(bundles.bearing_cost(free.position), cost.min(axis=0))


def fit_points(bundles: Bundles, index: Ints, landmark: Ints, noise: Floats, start: Floats) -> tuple[Floats, Floats, Floats]:
    """Fit points to groups of rays, from start values (N, 3) m.

    Returns the positions (N, 3) m, ln of their volumes (N,) m^3, and their largest standard deviations (N,) m over all
    directions. A volume is (2 pi)^1.5 times the root of the determinant of the covariance (Laplace's method). Without
    parallax, the usual distance of the class limits the volume and the standard deviation. index: (P,) the group of each
    ray. landmark, noise: (N,) the landmark and the noise factor of each group.
    """
    state, ray, count = bundles.state, bundles.ray, len(landmark)
    position = refine(state.obs, ray, index, start, noise)
    away = np.maximum(np.linalg.norm(position[index] - state.obs.origin[ray], axis=1), MIN_DEPTH)
    n = state.obs.direction[ray]
    across = (np.eye(3) - n[:, :, None] * n[:, None, :]) / variance(state.obs, away, noise[index], ray)[:, None, None]
    information = grouped_sums(across.reshape(-1, 9), index, count).reshape(-1, 3, 3)
    # A prior for each axis: the variance distance^2 / 12 of a uniform distribution over the usual distance.
    information += (12 / bundles.usual.distance[landmark] ** 2)[:, None, None] * np.eye(3)
    eigenvalues = np.linalg.eigvalsh(information)
    log_volume = 1.5 * np.log(2 * np.pi) - 0.5 * np.log(eigenvalues).sum(axis=1)
    return position, log_volume, 1 / np.sqrt(eigenvalues[:, 0])


def points_along(bundles: Bundles, steps: int = _STEPS) -> list[Floats]:
    """Return points (G, 3) m at several distances along the mean ray of each bundle, where its rays agree best.

    The distance counts from the foremost camera, so that the points lie in front of all cameras.
    """
    obs, ray, group, count = bundles.state.obs, bundles.ray, bundles.group, bundles.count
    mean = grouped_sums(obs.direction[ray], group, count)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    ahead = np.einsum("pi,pi->p", obs.origin[ray], mean[group])
    foremost = np.full(count, -np.inf)
    np.maximum.at(foremost, group, ahead)
    slope = np.maximum(np.einsum("pi,pi->p", obs.direction[ray], mean[group]), 0.1)
    points = []
    for share in np.geomspace(_NEAREST, _FURTHEST, steps).tolist():
        reach = (foremost[group] - ahead + share * bundles.usual.distance[bundles.landmark][group]) / slope
        weight = 1 / variance(obs, reach, bundles.noise[group], ray)
        at = obs.origin[ray] + reach[:, None] * obs.direction[ray]
        points.append(grouped_sums(weight[:, None] * at, group, count) / np.bincount(group, weight, count)[:, None])
    return points
