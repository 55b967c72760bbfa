"""Widen the covariances of objects whose ranges contradict their rays.

Rays from one side that end at different visible parts of a thing can cross far in front of it. This happens if something
without a box hides parts of the thing, such as the posts of a doorway. A robust solve then rejects all ranges of the thing,
and the place where its rays cross seems sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import NORMAL_MEDIAN, grouped_median
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.checks.residuals import held_rays

_FEWEST = 5
"""The fewest ranges that can contradict the rays of an object. With a larger number, fewer objects are tested."""
_SIGMAS = 2.0
"""The number of standard deviations between two places from which ranges contradict rays. One place is by the ranges, the
other by the rays. With a larger number, fewer objects become wider."""
_OBJECTS = 5
"""The fewest objects from which the error that the ranges of an object share is estimated. With a larger number, more logs
keep the error of the settings."""
_PARALLAX = 30.0
"""The largest angle (deg) between rays that do not place an object by themselves. Above this angle, ranges that contradict
the rays are wrong, such as ranges to the wall behind a table. With a larger angle, more objects become wider."""


def with_contradicting_ranges(
    objects: ObjectMap, map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, weight: Floats
) -> ObjectMap:
    """Return the objects, with wider covariances where ranges and rays contradict each other. They reach to the place by the
    ranges.

    The test is on the median difference between an object's ranges and its solved distances. This difference is compared
    with the covariance along the view and with the error that the ranges share. If the difference is larger, its square is
    added to the variance along the view. Nobody knows whether rays or ranges are right. map_T_camera: (K, 4, 4) the solved
    poses of the cameras at the keyframes. weight: (R,) the weight of each ray, 0 for a rejected one.
    """
    held = np.flatnonzero(held_rays(objects, association) & (rays.range > 0) & (weight > 0))
    if not len(held):
        return objects
    owner, count = association.object[held], len(objects)
    places = np.array([np.full(3, np.nan) if one.position is None else one.position for one in objects.objects])
    to = places[owner] - rays.in_map(map_T_camera)[0][held]
    distance = np.linalg.norm(to, axis=1)
    gap = grouped_median(rays.range[held] - distance, owner, count)
    bias = grouped_median(rays.range_bias[held], owner, count)
    number = np.bincount(owner, minlength=count)
    white = grouped_median(rays.range_sigma[held], owner, count) / np.sqrt(np.maximum(number, 1))
    total = np.column_stack([np.bincount(owner, column, count) for column in (to / distance[:, None]).T])
    way = total / np.maximum(np.linalg.norm(total, axis=1), 1e-9)[:, None]
    # A few things with wrong ranges, such as tables, make the estimated error of all objects too large.
    known = number >= _FEWEST
    if known.sum() >= _OBJECTS:
        usual = float(np.median(np.abs(gap[known]) / np.maximum(bias[known], 1e-9))) / NORMAL_MEDIAN
        bias = bias * min(usual, 1.0)
    changed = list(objects.objects)
    for j in np.flatnonzero(known).tolist():
        one, ahead = changed[j], way[j]
        if one.covariance is None or one.parallax_deg > _PARALLAX:
            continue
        expected = ahead @ one.covariance @ ahead + bias[j] ** 2 + white[j] ** 2
        if gap[j] ** 2 > _SIGMAS**2 * expected:
            changed[j] = replace(one, covariance=one.covariance + gap[j] ** 2 * np.outer(ahead, ahead))
    return replace(objects, objects=tuple(changed))
