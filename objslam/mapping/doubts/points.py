"""Fit a point at rest to each group of rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import closest_approach
from objslam.association.refinement import BEHIND, normalised_residuals, refine, squared_offsets
from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import grouped_median
from objslam.mapping.doubts.evidence import Evidence

MISSED = 3.0
"""The largest median deviation of rays that meet in a point, in standard deviations. The median deviation is 1.2 for rays
that differ from a point only by their noise. With a larger number, fewer groups have rays that do not meet."""
_NEAR, _FAR = 0.2, 100.0
"""The least and the greatest distance (m) of the point where a fit starts. Larger values suit larger places."""
_PAIRS = 64
"""The number of pairs of rays that are tried in a group. The crossings of the pairs give the start of a fit. More pairs give
a better start."""


@dataclass(frozen=True)
class Points:
    """G points, each fitted to a group of rays.

    ray, group: (Q,) the rays of all groups, and the group of each. position: (G, 3) m. deviation: (G,) the median deviation
    of the rays from their point, in standard deviations by the noise of their label in this log. miss, noise: (G,) m, the
    median distance between rays and point, and the median standard deviation of this distance along one axis.
    """

    ray: Ints
    group: Ints
    position: Floats
    deviation: Floats
    miss: Floats
    noise: Floats


def fit_points(evidence: Evidence, groups: list[Ints], start: Floats | None = None) -> Points:
    """Return a point for each group of rays. start: (G, 3) m, where the fits start, by default at a crossing of their
    rays."""
    obs, count = evidence.state.obs, len(groups)
    ray = np.concatenate([*groups, np.zeros(0, dtype=np.int64)])
    group = np.repeat(np.arange(count), [len(one) for one in groups])
    if start is None:
        start = np.array([_crossing(evidence, one) for one in groups]).reshape(-1, 3)
    label = np.array([obs.label[one[0]] for one in groups], dtype=np.int64)
    factor = evidence.state.class_noise[label]
    position = refine(obs, ray, group, start, factor) if count else start
    off = np.minimum(normalised_residuals(obs, position[group], of=ray) / factor[group], BEHIND)
    squared, distance = squared_offsets(obs, position[group], ray)
    sigma = factor[group] * np.hypot(obs.sigma[ray] * distance, obs.position_sigma)
    miss = np.minimum(np.sqrt(squared), distance)
    medians = grouped_median(np.stack([off, miss, sigma], axis=1), group, count) if count else np.zeros((0, 3))
    return Points(ray, group, position, *medians.T)


def as_landmarks(evidence: Evidence, points: Points) -> State:
    """Return the state with the points as additional landmarks, behind the landmarks of the objects."""
    state = evidence.state
    first = np.searchsorted(points.group, np.arange(len(points.position)))
    label = state.obs.label[points.ray[first]]
    new = Landmarks.new(points.position, state.class_noise[label], label, len(state.unassigned))
    matched = state.matched.copy()
    matched[points.ray] = state.count + points.group
    return replace(state, landmarks=state.landmarks.and_also(new), matched=matched)


def _crossing(evidence: Evidence, rays: Ints) -> Floats:
    """Return a point (3,) near the crossings of rays: the median over pairs of rays that cross ahead of both cameras."""
    obs, rng = evidence.state.obs, np.random.default_rng(len(rays))
    a, b = rng.choice(rays, (2, _PAIRS))
    ahead, behind, middle, _, sin2 = closest_approach(obs, a, b)
    good = (ahead > _NEAR) & (behind > _NEAR) & (ahead < _FAR) & (sin2 > 1e-5)
    if good.any():
        return np.asarray(np.median(middle[good], axis=0))
    usual = evidence.state.distance
    return np.asarray(obs.origin[a[0]] + (float(np.median(usual)) if len(usual) else 1.0) * obs.direction[a[0]])
