"""Points from the rays that were given to them, all at once: iterated weighted least squares of the bearing's deviations."""

from __future__ import annotations

import numpy as np

from objslam.association.landmarks import variance
from objslam.association.sightings import Sightings
from objslam.types import Floats, Ints

_CAUCHY = 6.0  # squared deviations at which a ray counts half
_RANGE_CAUCHY = 3.0
_DAMPING = 1e-6  # of the information: along a direction that the rays do not fix, a point stays where it is
_ITERATIONS = 6


def refit(s: Sightings, ray: Ints, index: Ints, start: Floats, noise: Floats) -> Floats:
    """Positions (N, 3), m, of points from pairs of a ray (P,) and the point (P,) that has it; several may have one ray.

    start: (N, 3) m, where points stay along directions that their rays do not fix. noise: (N,) factor on the rays' noise.
    """
    count = len(start)
    order = np.argsort(index, kind="stable")
    r, index = s.take(ray[order]), index[order]
    along = r.direction[:, :, None] * r.direction[:, None, :]
    ranged = np.isfinite(r.range)
    number = np.maximum(np.bincount(index, minlength=count), 1)
    position = start.copy()
    for _ in range(_ITERATIONS):
        to = position[index] - r.origin
        depth = np.einsum("ri,ri->r", to, r.direction)
        offset = to - depth[:, None] * r.direction
        distance = np.maximum(np.linalg.norm(to, axis=1), 1e-6)
        toward = to / distance[:, None]
        # an angle does not change along the line of sight to the point, which the ray itself only nearly is
        across = np.eye(3) - toward[:, :, None] * toward[:, None, :]
        spread = variance(r, distance, noise[index])
        weight = 1 / (spread + np.einsum("ri,ri->r", offset, offset) / _CAUCHY)
        beyond = np.where(ranged, r.range - depth, 0.0)
        range_weight = np.where(ranged, 1 / r.range_sigma**2 / (1 + (beyond / r.range_sigma) ** 2 / _RANGE_CAUCHY) ** 2, 0.0)
        information = weight[:, None, None] * across + range_weight[:, None, None] * along
        pull = (range_weight * beyond)[:, None] * r.direction - weight[:, None] * (across @ offset[:, :, None])[:, :, 0]
        total = sums(information.reshape(-1, 9), index, count).reshape(-1, 3, 3)
        total += (_DAMPING * np.trace(total, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        step = np.linalg.solve(total, sums(pull, index, count)[:, :, None])[:, :, 0]
        # under little parallax a full step may go anywhere; no step is longer than the point is away
        length, reach = np.linalg.norm(step, axis=1), np.bincount(index, distance, count) / number
        position = position + step * np.minimum(1.0, reach / np.maximum(length, 1e-12))[:, None]
    return position


def sums(values: Floats, index: Ints, count: int) -> Floats:
    """Sums (count, D) of the values (P, D) of each group; index: (P,) group of each row."""
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1).astype(np.float64)
