"""Merge objects that are in the map twice, because the poses drifted between two visits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.association.appearance.evidence import Looks, learn_ratio
from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.core.statistics import SAME_POINT
from objslam.core.types import Association, Rays

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate


def merge_unseen_together(rays: Rays, association: Association, estimate: Estimate, farthest: float) -> Association:
    """Merge pairs of objects of one label whose positions agree within their covariances, and that share no frame.

    Each of the two copies fits the drifted poses of its visit, so a new association at these poses keeps both. The merge
    closes the loop. The nearest pairs by Mahalanobis distance merge first. An object merges at most once in one call. A pair
    whose boxes look alike may lie further apart, and a pair whose boxes differ must lie nearer. farthest: the largest
    distance (m) of a pair.
    """
    position, covariance = estimate.positions, estimate.covariance
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]) & np.isfinite(position[:, 0]))
    a, b, apart = near_pairs(position[known], association.label[known], farthest)
    a, b = known[a], known[b]
    squared = np.einsum("pi,pi->p", apart, np.linalg.solve(covariance[a] + covariance[b], apart[..., None])[..., 0])
    ratio = learn_ratio(rays, rays.keyframe, rays.track_id, association.object, len(rays.label_names))
    if ratio is not None:
        looks = Looks.of(rays, association.object, association.count, ratio)
        squared = squared - 2 * looks.landmark_odds(a, b, association.label[a])
    order = np.argsort(squared, kind="stable")
    order = order[squared[order] < SAME_POINT]
    held = association.object >= 0
    frames: list[set[int]] = [set() for _ in range(association.count)]
    for j, k in zip(association.object[held].tolist(), rays.keyframe[held].tolist(), strict=True):
        frames[j].add(k)
    into = np.arange(association.count)
    taken = np.zeros(association.count, dtype=bool)
    for i, j in zip(a[order].tolist(), b[order].tolist(), strict=True):
        together = len(frames[i] & frames[j])
        if taken[i] or taken[j] or seen_as_two(together, min(len(frames[i]), len(frames[j]))):
            continue
        keep, drop = (i, j) if len(frames[i]) >= len(frames[j]) else (j, i)
        into[drop], taken[i], taken[j] = keep, True, True
    kept = np.flatnonzero(into == np.arange(association.count))
    number = np.searchsorted(kept, into)
    weights, existence = association.label_weights, association.existence
    return Association(
        object=np.append(number, -1)[association.object],  # The index -1 (no object) reads the last entry, -1.
        label=association.label[kept],
        label_weights=None if weights is None else weights[kept],
        existence=None if existence is None else existence[kept],
    )
