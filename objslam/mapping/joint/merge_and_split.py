"""Merge objects that are in the map twice, and split objects that may be two things. Drift between two visits causes both
errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.association.appearance.evidence import Looks, learn_ratio
from objslam.association.crossings.bundles import second_bundle
from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import SAME_POINT
from objslam.core.types import Association, Rays

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate

_GAP = np.radians(15.0)
"""The least gap (rad) between the directions of two bundles of rays. A robot that drives past a thing sees it from all
directions between the first and the last, apart from missed boxes. With a smaller gap, more objects are split on trial,
which takes time."""


def merge_unseen_together(rays: Rays, association: Association, estimate: Estimate, farthest: float) -> Association:
    """Return the association with some pairs of objects merged. The two objects of a pair have one label, agree within their
    covariances, and share no frame.

    Two copies of a thing each fit the drifted poses of their visit, so a new association at these poses keeps both. The
    merge closes the loop. The nearest pairs by Mahalanobis distance merge first. An object merges at most once in one call.
    A few shared frames are allowed (`seen_as_two`). A pair whose boxes look alike may lie further apart. A pair whose boxes
    differ must lie nearer. farthest: the largest distance (m) of a pair.
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
    return joined(association, into)


def joined(association: Association, into: Ints) -> Association:
    """Return the association after joins of objects. into: (N,) the object that each object becomes, or itself."""
    kept = np.flatnonzero(into == np.arange(association.count))
    number = np.searchsorted(kept, into)
    weights, existence = association.label_weights, association.existence
    return Association(
        object=np.append(number, -1)[association.object],  # The index -1 (no object) reads the last entry, -1.
        label=association.label[kept],
        label_weights=None if weights is None else weights[kept],
        existence=None if existence is None else existence[kept],
    )


def split_at_gaps(direction: Floats, association: Association, used: Bools, fewest: int) -> Association:
    """Return the association with some objects split. The rays of a split object come in two bundles with a wide gap between
    their directions.

    The bundles may be two things, such as the signs on both sides of a wall. If the path is bent to bring the two things
    together, all rays of both agree with one point.

    Args: direction: (R, 3) unit, of the rays in map. association: the association of the rays. The second bundle of an
    object becomes a new object of the same label. used: (R,) whether each ray agrees with its object. The other rays go with
    the bundle on their side of the gap. fewest: the fewest used rays of a bundle.

    A new object has the labels and the existence of the object that was split.
    """
    held = np.flatnonzero(association.object >= 0)
    owner, count = association.object[held], association.count
    beyond = second_bundle(direction[held], owner, count, _GAP, used[held], fewest)
    two = np.flatnonzero(np.bincount(owner, beyond, count))
    second = np.full(count, -1)
    second[two] = count + np.arange(len(two))
    found = association.object.copy()
    found[held[beyond]] = second[owner[beyond]]
    weights, existence = association.label_weights, association.existence
    return Association(
        found,
        np.append(association.label, association.label[two]),
        label_weights=None if weights is None else np.concatenate([weights, weights[two]]),
        existence=None if existence is None else np.append(existence, existence[two]),
    )
