"""Objects whose rays do not agree. Such rays miss their object by more than their noise, and by more than the rays of other
objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import CLIPPED_RAY
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.checks.residuals import held_rays, promised_noise

_LEAST = 1.5
"""The least misfit (`Misfits.times`) of an object whose rays do not agree. At 1.5, more than half of the variance of its
rays is unexplained. A larger value finds fewer objects."""
_TIMES = 3.0
"""An object is odd only if its misfit is also at least this multiple of the median misfit of all objects. Association
accepts rays that are up to 3 times as noisy as the settings say. If all rays of a log are noisy, the object is not the
cause. A larger value finds fewer objects."""
_SIGMAS = 3.0
"""An object is odd only if the chi-squared of its rays exceeds its expectation by this number of standard deviations. A
larger number finds fewer objects with few rays."""
_PLACE = 3
"""The number of coordinates of a position. Chi-squared has two degrees of freedom for each ray, less this number."""


@dataclass(frozen=True)
class Misfits:
    """How well the rays of N objects agree.

    times: (N,) the misfit of each object: the root of chi-squared per degree of freedom of its used rays. Chi-squared is
    relative to the expected noise. The misfit is NaN for an object without a position, or with a single ray. usual: the
    median of `times`. odd: (N,) whether the rays of an object do not agree.
    """

    times: Floats
    usual: float
    odd: Bools


def find_misfits(
    objects: ObjectMap,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    residual: Floats,
    weight: Floats,
    settings: Settings,
) -> Misfits:
    """Return how well the rays of each object agree.

    If an object mixes two things that cross, its rays do not agree with one point. The rays of boxes that often show only a
    part of their thing do not agree either. A ray that is farther off than `CLIPPED_RAY` standard deviations counts as one
    at that distance. residual: (R,) the angle (rad) between each ray and its object. weight: (R,) the robust weights, 0 for
    a rejected ray.
    """
    count, held = len(objects), held_rays(objects, association)
    times, odd = np.full(count, np.nan), np.zeros(count, dtype=bool)
    if not held.any():
        return Misfits(times, float("nan"), odd)
    squared = (residual[held] / promised_noise(objects, keyframes, rays, association, settings)) ** 2
    used = weight[held] > 0
    owner = association.object[held][used]
    number = np.bincount(owner, minlength=count)
    several = number > 1
    if not several.any():
        return Misfits(times, float("nan"), odd)
    free = np.maximum(2 * number - _PLACE, 1)
    chi2 = np.bincount(owner, np.minimum(squared[used], CLIPPED_RAY**2), count) / free
    times[several] = np.sqrt(chi2[several])
    usual = float(np.median(times[several]))
    odd[several] = (chi2 > np.maximum(_LEAST**2, 1 + _SIGMAS * np.sqrt(2 / free)))[several]
    odd[several] &= times[several] > _TIMES * usual
    return Misfits(times, usual, odd)


def with_misfits(objects: ObjectMap, misfits: Misfits) -> ObjectMap:
    """Return the objects with larger covariances where the rays do not agree. The factor is chi-squared per degree of
    freedom (the ratio of Birge 1932)."""
    changed = [
        replace(one, covariance=one.covariance * misfits.times[j] ** 2)
        if misfits.odd[j] and one.covariance is not None
        else one
        for j, one in enumerate(objects.objects)
    ]
    return replace(objects, objects=tuple(changed))
