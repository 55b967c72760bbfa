"""Find objects that may be two: their rays fall into two groups that meet at two places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.refinement import refine
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import CLIPPED_RAY, grouped_sums
from objslam.mapping.doubts.evidence import Evidence

_FEWEST = 5
"""The fewest rays of each of the two groups. A larger number finds fewer objects that are two."""
_LEAST_SHARE = 0.1
"""The least share of an object's rays in the smaller group. Below it, the group is a few outliers. A larger share finds
fewer objects that are two."""
_APART = (3.8, 85.0)
"""The least distance between the groups, in standard deviations within them: the first number, plus the second divided by
the number of rays. Of objects whose rays scatter evenly, 1 in 10,000 has groups at this distance (simulated for 15 to 300
rays). With Gaussian scatter, fewer objects have groups this far apart. Larger numbers find fewer objects that are two."""
_ABOVE_NOISE = 3.0
"""The least distance between the groups, in standard deviations of a ray. This deviation is the one that all rays of the
label show in this log. A larger number finds fewer objects that are two."""
_WITHIN_SIZE = 0.35
"""The least distance between the groups, as a share of the object's size. Box centres wander within their object. A larger
share finds fewer objects that are two."""
_ROUNDS = 8
"""The rounds of two-means. They converge in fewer rounds. A larger number is slower."""


@dataclass(frozen=True)
class Splits:
    """S objects that may be two.

    object: (S,) indices into the map. centre: (S, 2, 3) m, where the rays of each group meet. rays: (S, 2) the number of
    rays of each group. gap: (S,) m, the distance between the groups across the rays. noise: (S,) m, the standard deviation
    of a ray at the object along one axis. together: (S,) the number of frames with a ray of each group.
    """

    object: Ints
    centre: Floats
    rays: Ints
    gap: Floats
    noise: Floats
    together: Ints

    def __len__(self) -> int:
        return len(self.object)


def find_splits(evidence: Evidence) -> Splits:
    """Return the objects that may be two.

    The offsets between an object and its rays have a direction along which they scatter most. Two-means along this direction
    gives two groups. The groups are two things if the distance between them is large compared with three lengths: their own
    scatter, the noise of the rays of this label in this log, and the size of the object.
    """
    state, count = evidence.state, evidence.state.count
    obs, owner, ray = state.obs, state.owner, state.assigned
    if not len(ray):
        return Splits(owner, np.zeros((0, 2, 3)), np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0), owner)
    to = state.landmarks.position[owner] - obs.origin[ray]
    depth = np.einsum("pi,pi->p", to, obs.direction[ray])
    offset = depth[:, None] * obs.direction[ray] - to
    # The noise of the label counts, because the own noise of an object that is two things is too large.
    sigma = np.sqrt(state.variance) / state.landmarks.noise[owner] * state.class_noise[state.label[owner]]
    scaled = offset / sigma[:, None]
    scaled *= np.minimum(1.0, CLIPPED_RAY / np.maximum(np.linalg.norm(scaled, axis=1), 1e-9))[:, None]
    scatter = grouped_sums((scaled[:, :, None] * scaled[:, None, :]).reshape(-1, 9), owner, count).reshape(-1, 3, 3)
    worst = np.linalg.eigh(scatter)[1][:, :, -1][owner]
    across = worst - np.einsum("pi,pi->p", worst, obs.direction[ray])[:, None] * obs.direction[ray]
    seen = np.einsum("pi,pi->p", across, across)  # A ray along the worst direction tells nothing about it.
    along = np.einsum("pi,pi->p", offset, across) / np.maximum(seen, 0.05)
    weight = np.where(depth > 0, seen / sigma**2, 0.0)
    upper, low, high = _two_means(along, weight, owner, count)
    number = np.stack([np.bincount(owner[~upper], minlength=count), np.bincount(owner[upper], minlength=count)], axis=1)
    gap = high - low
    rest = along - np.where(upper, high[owner], low[owner])
    within = np.sqrt(_mean(rest**2, weight, owner, count))
    noise = np.sqrt(np.bincount(owner, weights=seen, minlength=count) / np.maximum(np.bincount(owner, weight, count), 1e-12))
    least = _APART[0] + _APART[1] / np.maximum(state.ray_count, 1)
    two = (number.min(axis=1) >= np.maximum(_FEWEST, _LEAST_SHARE * number.sum(axis=1))) & (gap > least * within)
    two &= (gap > _ABOVE_NOISE * noise) & (gap > _WITHIN_SIZE * state.size)
    return _described(evidence, np.flatnonzero(two), upper, gap, noise)


def _two_means(value: Floats, weight: Floats, owner: Ints, count: int) -> tuple[Bools, Floats, Floats]:
    """Return which values (P,) of each object are in its upper group, and the means (N,) of its lower and upper group."""
    border = _mean(value, weight, owner, count)
    for _ in range(_ROUNDS):
        upper = value > border[owner]
        low, high = (_mean(value[part], weight[part], owner[part], count) for part in (~upper, upper))
        border = (low + high) / 2
    return upper, low, high


def _mean(value: Floats, weight: Floats, owner: Ints, count: int) -> Floats:
    """Return the weighted mean (N,) of the values (P,) of each object."""
    return np.asarray(np.bincount(owner, weight * value, count) / np.maximum(np.bincount(owner, weight, count), 1e-12))


def _described(evidence: Evidence, two: Ints, upper: Bools, gap: Floats, noise: Floats) -> Splits:
    """Return a description of the objects `two` (S,), which are indices of landmarks. upper: (P,) the group of each ray.
    gap, noise: (N,) m."""
    state, obs = evidence.state, evidence.state.obs
    number = np.full(state.count, -1)
    number[two] = np.arange(len(two))
    mine = np.flatnonzero(number[state.owner] >= 0)
    half = 2 * number[state.owner[mine]] + upper[mine]
    ray = state.assigned[mine]
    rays = np.bincount(half, minlength=2 * len(two)).reshape(-1, 2)
    start = np.repeat(state.landmarks.position[two], 2, axis=0)
    factor = np.repeat(state.class_noise[state.label[two]], 2)
    centre = refine(obs, ray, half, start, factor).reshape(-1, 2, 3) if len(two) else np.zeros((0, 2, 3))
    frames = int(obs.frame.max(initial=0)) + 1
    first, second = (np.unique(half[half % 2 == k] // 2 * frames + obs.frame[ray[half % 2 == k]]) for k in (0, 1))
    together = np.bincount(np.intersect1d(first, second) // frames, minlength=len(two))
    return Splits(evidence.object[two], centre, rays, gap[two], noise[two], together)
