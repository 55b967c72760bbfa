"""Which object of the map is which object of the ground truth, and how the map lies on the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from objslam.geometry import align, inverse, lift_se2
from objslam.types import Bools, Floats, Ints, ObjectMap, Trajectory, Truth

Alignment = Literal["none", "se2", "sim2"]

_MAX_PAIRS = 3000
_MAX_ROUNDS = 50
_REFINED = 12
_SCALES = (0.1, 10.0)


@dataclass(frozen=True)
class Transform:
    """scale * rotation @ point + translation, as `objslam.geometry.align` gives it: pose (4, 4) and scale."""

    pose: Floats
    scale: float = 1.0

    def apply(self, points: Floats) -> Floats:
        """Points (..., 3) moved."""
        return self.scale * points @ self.pose[:3, :3].T + self.pose[:3, 3]


IDENTITY = Transform(np.eye(4))


def match(source: Floats, target: Floats, same: Bools, radius: float) -> tuple[Ints, Ints]:
    """One-to-one pairs between points (N, 3) and (M, 3), indices in increasing order of the first.

    As many pairs as can be within `radius` where `same` (N, M), and of those choices the one with the least sum of squared
    distances (Hungarian method).
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
    source: Floats,
    target: Floats,
    same: Bools,
    radius: float,
    kind: Alignment,
    start: Transform | None = None,
    seed: int = 0,
) -> Transform:
    """The transform that lays map objects (N, 3) onto true ones (M, 3), where `same` (N, M) says who may be whom.

    From each start, match within `radius`, align to the matches, and again until the matches stay (iterated closest points
    with one-to-one matches); the best has the least sum over the true objects of min(distance, radius)^2. The start is the
    one given, else every pair of map objects put onto a pair of true ones that they may be and that lies as far apart (a
    random 3,000 of those pairs when there are more; seeded).
    """
    if kind == "none" or not same.any():
        return IDENTITY
    starts = [start] if start is not None else _starts(source, target, same, radius, kind, seed)
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
    before: tuple[Ints, Ints] | None = None
    for _ in range(_MAX_ROUNDS):
        moved = transform.apply(source)
        rows, columns = match(moved, target, same, radius)
        cost = float(((moved[rows] - target[columns]) ** 2).sum()) + radius**2 * (len(target) - len(rows))
        if cost < best_cost:
            best, best_cost = transform, cost
        stays = before is not None and np.array_equal(rows, before[0]) and np.array_equal(columns, before[1])
        if stays or len(rows) == 0:
            break
        before = rows, columns
        transform = Transform(*align(source[rows], target[columns], kind))
    return best, best_cost


def _starts(source: Floats, target: Floats, same: Bools, radius: float, kind: Alignment, seed: int) -> list[Transform]:
    """Transforms from pairs of correspondences, the most promising first."""
    i, k = np.nonzero(same)
    first, second = np.triu_indices(len(i), 1) if len(i) <= 2000 else _random_pairs(len(i), seed)
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
    if len(chosen) > _MAX_PAIRS:
        chosen = np.sort(np.random.default_rng(seed).choice(chosen, _MAX_PAIRS, replace=False))
    if len(chosen) == 0:  # one correspondence, or none that agree: only the place can be aligned
        return [Transform(*align(source[[i[c]]], target[[k[c]]], kind)) for c in range(min(len(i), _REFINED))]
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
    return [Transform(poses[h], float(scale[h])) for h in np.argsort(costs, kind="stable")[:_REFINED]]


def _nearest_cost(transform: Transform, source: Floats, target: Floats, same: Bools, radius: float) -> float:
    """Sum over the true objects of min(distance to the nearest it may be, radius)^2."""
    squared = ((transform.apply(source)[:, None] - target[None]) ** 2).sum(axis=2)
    return float(np.minimum(np.where(same, squared, np.inf).min(axis=0), radius**2).sum())


def _random_pairs(count: int, seed: int) -> tuple[Ints, Ints]:
    pairs = np.random.default_rng(seed).integers(count, size=(200_000, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return pairs[:, 0], pairs[:, 1]


def lay_truth(objects: ObjectMap, truth: Truth, radius: float = 0.5) -> Truth:
    """The truth as it lies on the map, to be drawn there.

    A map from odometry alone has a frame of its own. Where fewer than half of what could match does within the radius (m) as
    the two stand, and more does after an alignment in the plane, the truth is moved by that alignment; else it stays.
    """
    mapped, true = objects.resolved(), truth.objects
    ours = np.array([o.position for o in mapped]).reshape(-1, 3)
    theirs = np.array([o.position for o in true]).reshape(-1, 3)
    same = np.array([[o.label == t.label for t in true] for o in mapped], dtype=bool).reshape(len(ours), len(theirs))
    matched = len(match(ours, theirs, same, radius)[0])
    if 2 * matched >= min(len(ours), len(theirs)):
        return truth
    transform = align_objects(ours, theirs, same, radius, "se2")
    if len(match(transform.apply(ours), theirs, same, radius)[0]) <= matched:
        return truth
    back = Transform(inverse(transform.pose))
    path = truth.trajectory
    return Truth(
        objects=tuple(replace(t, position=back.apply(t.position)) for t in true),
        trajectory=None if path is None else Trajectory(path.stamps, back.pose @ path.poses),
    )
