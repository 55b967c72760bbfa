"""Which object of the map is which object of the ground truth, and how the map lies on the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import align, inverse, lift_se2
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Trajectory, Truth, TruthObject

Alignment = Literal["none", "se2", "sim2"]
"""How a map is laid onto the truth: not at all; turned about z and moved; or turned, moved and scaled."""

_MAX_CORRESPONDENCES = 2000  # With more possible correspondences than this, their pairs are drawn at random.
_DRAWN_PAIRS = 200_000  # How many pairs of correspondences are drawn then.
_MAX_STARTS = 3000  # The largest number of starting transforms that are scored.
_MAX_REFINED = 12  # How many of the best starts are refined: more find the right one more surely and take longer.
_MAX_ROUNDS = 50  # The largest number of rounds of matching and aligning: a bound, should the matches never stay.
_SCALES = (0.1, 10.0)  # The smallest and largest scale of a map, as a ratio to the truth, that sim2 looks for.


@dataclass(frozen=True)
class Transform:
    """scale * rotation @ point + translation, as `objslam.core.geometry.align` gives it: pose (4, 4) and scale."""

    pose: Floats
    scale: float = 1.0

    def apply(self, points: Floats) -> Floats:
        """Points (..., 3) moved."""
        return self.scale * points @ self.pose[:3, :3].T + self.pose[:3, 3]


IDENTITY = Transform(np.eye(4))
"""The transform that leaves every point where it is."""


def correspondences(objects: Sequence[MapObject], truth: Sequence[TruthObject]) -> tuple[Floats, Floats, Bools]:
    """Positions (N, 3) of map objects, positions (M, 3) of true objects, m, and which of them share a label (N, M)."""
    source = np.array([o.position for o in objects]).reshape(-1, 3)
    target = np.array([t.position for t in truth]).reshape(-1, 3)
    same = np.array([[o.label == t.label for t in truth] for o in objects], dtype=bool)
    return source, target, same.reshape(len(source), len(target))


def match_points(source: Floats, target: Floats, same: Bools, radius: float) -> tuple[Ints, Ints]:
    """One-to-one pairs between two sets of points, by the Hungarian method.

    The pairs are as many as possible; among equally many, they have the least sum of squared distances.

    Args:
        source, target: (N, 3) and (M, 3) m.
        same: (N, M) which points may be paired.
        radius: m, the largest distance of a pair.
    Returns:
        The pairs' indices into source, increasing, and into target.
    """
    from scipy.optimize import linear_sum_assignment

    if not same.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    squared = ((source[:, None] - target[None]) ** 2).sum(axis=2)
    allowed = same & (squared <= radius**2)
    # not allowed costs more than any number of pairs within the radius
    rows, columns = linear_sum_assignment(np.where(allowed, squared, 2 * radius**2 * (min(squared.shape) + 1)))
    kept = allowed[rows, columns]
    return rows[kept], columns[kept]


def align_objects(
    source: Floats, target: Floats, same: Bools, radius: float, kind: Alignment, start: Transform | None = None
) -> Transform:
    """The transform that lays map objects onto true ones: iterated closest points with one-to-one matches.

    From each start, points are matched within the radius and aligned to their matches, until the matches stay. The best
    transform has the least sum over the true objects of min(distance, radius)^2.

    Args:
        source, target: (N, 3) map objects and (M, 3) true ones, m.
        same: (N, M) which may be the same object.
        start: where to start. Without it, every pair of map objects is put onto every pair of true objects that they may be
            and that lies as far apart; of more than 3,000 of those pairs, 3,000 are drawn at random, always the same.
    """
    if kind == "none" or not same.any():
        return IDENTITY
    starts = [start] if start is not None else _starts(source, target, same, radius, kind)
    best, best_cost = IDENTITY, np.inf
    for transform in starts:
        transform, cost = _refine(source, target, same, radius, kind, transform)
        if cost < best_cost:
            best, best_cost = transform, cost
    return best


def _refine(
    source: Floats, target: Floats, same: Bools, radius: float, kind: Alignment, transform: Transform
) -> tuple[Transform, float]:
    best, best_cost = transform, np.inf
    before: Ints = np.zeros((2, 0), dtype=np.int64)
    for _ in range(_MAX_ROUNDS):
        moved = transform.apply(source)
        rows, columns = matches = np.stack(match_points(moved, target, same, radius))
        cost = float(((moved[rows] - target[columns]) ** 2).sum()) + radius**2 * (len(target) - len(rows))
        if cost < best_cost:
            best, best_cost = transform, cost
        if len(rows) == 0 or np.array_equal(matches, before):
            break
        before = matches
        transform = Transform(*align(source[rows], target[columns], kind))
    return best, best_cost


def _starts(source: Floats, target: Floats, same: Bools, radius: float, kind: Alignment) -> list[Transform]:
    """Transforms that put one pair of correspondences onto each other, the most promising first."""
    i, k = np.nonzero(same)
    first, second = np.triu_indices(len(i), 1) if len(i) <= _MAX_CORRESPONDENCES else _random_pairs(len(i))
    distinct = (i[first] != i[second]) & (k[first] != k[second])
    first, second = first[distinct], second[distinct]
    a, b = source[i[second], :2] - source[i[first], :2], target[k[second], :2] - target[k[first], :2]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    likely = np.minimum(length_a, length_b) > 1e-9
    if kind == "se2":
        likely &= np.abs(length_a - length_b) <= 2 * radius
    else:
        likely &= (length_a * _SCALES[0] <= length_b) & (length_b <= length_a * _SCALES[1])
    chosen = np.flatnonzero(likely)
    if len(chosen) > _MAX_STARTS:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, _MAX_STARTS, replace=False))
    if len(chosen) == 0:  # there is one correspondence, or none agree: only the position can be aligned
        return [Transform(*align(source[[i[c]]], target[[k[c]]], kind)) for c in range(min(len(i), _MAX_REFINED))]
    first, second, a, b = first[chosen], second[chosen], a[chosen], b[chosen]
    yaw = np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(a[:, 1], a[:, 0])
    scale = length_b[chosen] / length_a[chosen] if kind == "sim2" else np.ones(len(chosen))
    poses = lift_se2(np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=-1))
    middle_a = (source[i[first]] + source[i[second]]) / 2
    middle_b = (target[k[first]] + target[k[second]]) / 2
    poses[:, :3, 3] = middle_b - scale[:, None] * np.einsum("hij,hj->hi", poses[:, :3, :3], middle_a)
    costs = [
        _nearest_cost(Transform(pose, float(s)), source, target, same, radius) for pose, s in zip(poses, scale, strict=True)
    ]
    return [Transform(poses[h], float(scale[h])) for h in np.argsort(costs, kind="stable")[:_MAX_REFINED]]


def _nearest_cost(transform: Transform, source: Floats, target: Floats, same: Bools, radius: float) -> float:
    """Sum over the true objects of min(distance to the nearest it may be, radius)^2."""
    squared = ((transform.apply(source)[:, None] - target[None]) ** 2).sum(axis=2)
    return float(np.minimum(np.where(same, squared, np.inf).min(axis=0), radius**2).sum())


def _random_pairs(count: int) -> tuple[Ints, Ints]:
    pairs = np.random.default_rng(0).integers(count, size=(_DRAWN_PAIRS, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return pairs[:, 0], pairs[:, 1]


def lay_truth(objects: ObjectMap, truth: Truth, radius: float = 0.5) -> Truth:
    """The truth as it lies on the map, to be drawn there.

    A map from odometry alone has a frame of its own. The truth is moved by an alignment in the plane where fewer than half
    of what could match does so within the radius (m), and the alignment makes more of it match. Otherwise it stays.
    """
    source, target, same = correspondences(objects.resolved(), truth.objects)
    matched = len(match_points(source, target, same, radius)[0])
    if 2 * matched >= min(len(source), len(target)):
        return truth
    transform = align_objects(source, target, same, radius, "se2")
    if len(match_points(transform.apply(source), target, same, radius)[0]) <= matched:
        return truth
    back = Transform(inverse(transform.pose))
    path = truth.trajectory
    return Truth(
        objects=tuple(replace(t, position=back.apply(t.position)) for t in truth.objects),
        trajectory=None if path is None else Trajectory(path.stamps, back.pose @ path.poses),
    )
