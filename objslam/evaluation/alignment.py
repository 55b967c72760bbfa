"""Match map objects with true objects, and align the map with the ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import align, inverse, lift_se2, make_pose
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth, TruthObject

Alignment = Literal["none", "se2", "sim2", "se3", "sim3"]
"""The kind of the alignment of a map with the truth: none, se2 (yaw and translation), se3 (rotation and translation), sim2
(se2 with a scale) or sim3 (se3 with a scale)."""

_MAX_CORRESPONDENCES = 2000  # The most correspondences of which all pairs are tried, not a sample. More are slower.
_DRAWN_PAIRS = 200_000  # The number of sampled pairs or triples of correspondences. A larger number is slower.
_MAX_TRIPLED = 80  # The most correspondences of which all triples (82,160) are tried, not a sample. More are slower.
_MAX_STARTS = 3000  # The most initial transforms from pairs that are scored. A larger number is slower.
_MAX_TRIPLES = 1000  # The most initial transforms from triples. Triples are right more often than pairs, so fewer suffice.
_DISTANCES = 1_000_000  # The number of distances computed at once. A larger number takes more memory: 24 MB for a million.
_MAX_REFINED = 12  # The number of the best initial transforms that are refined. A larger number is more reliable and slower.
_MAX_ROUNDS = 50
"""The largest number of rounds of matching and aligning if the matches do not converge. A larger number takes longer."""
_ON_A_LINE = 0.02
"""The largest sine of an angle of a triangle whose corners count as on a line. With position errors of 2 % of the triangle's
length, the rotation about this line is unknown. A larger value leaves out more triples."""
_SCALES = (0.1, 10.0)  # The smallest and largest scale from map to truth that sim2 and sim3 search.


@dataclass(frozen=True)
class Transform:
    """The transform of a point into scale * rotation @ point + translation. `pose` (4, 4) has rotation and translation."""

    pose: Floats
    scale: float = 1.0

    def apply(self, points: Floats) -> Floats:
        """Return points (..., 3), m, after the transform."""
        return self.scale * points @ self.pose[:3, :3].T + self.pose[:3, 3]


IDENTITY = Transform(np.eye(4))
"""The identity transform."""


def correspondences(objects: Sequence[MapObject], truth: Sequence[TruthObject]) -> tuple[Floats, Floats, Bools]:
    """Return positions (N, 3) of map objects and (M, 3) of true objects, m, and a mask (N, M): True if labels are equal."""
    source = np.array([o.position for o in objects]).reshape(-1, 3)
    target = np.array([t.position for t in truth]).reshape(-1, 3)
    same = np.array([[o.label == t.label for t in truth] for o in objects], dtype=bool)
    return source, target, same.reshape(len(source), len(target))


def match_points(source: Floats, target: Floats, same: Bools, radius: float) -> tuple[Ints, Ints]:
    """Match two sets of points one-to-one by the Hungarian method.

    The number of pairs is maximal. Among the maximal matchings, the sum of squared distances is minimal.

    Args:
        source, target: points (N, 3) and (M, 3) in m.
        same: (N, M), True if two points may be a pair.
        radius: maximum distance of a pair in m.
    Returns:
        For each pair, the index of its point in `source` (increasing), and the index of its point in `target`.
    """
    if not same.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    squared = ((source[:, None] - target[None]) ** 2).sum(axis=2)
    allowed = same & (squared <= radius**2)
    if allowed.sum(axis=0).max() <= 1 and allowed.sum(axis=1).max() <= 1:
        rows, columns = np.nonzero(allowed)  # No point has a choice, so the slow import below is not needed.
        return rows, columns
    from scipy.optimize import linear_sum_assignment

    # A forbidden pair costs more than all allowed pairs together, so the number of allowed pairs is as large as possible.
    rows, columns = linear_sum_assignment(np.where(allowed, squared, 2 * radius**2 * (min(squared.shape) + 1)))
    kept = allowed[rows, columns]
    return rows[kept], columns[kept]


def align_objects(
    source: Floats, target: Floats, same: Bools, radius: float, kind: Alignment, start: Transform | None = None
) -> Transform:
    """Align map objects with true objects by iterative closest point (ICP) with one-to-one matches.

    From each initial transform, points are matched within the radius and aligned with their matches, until the matches
    converge. The function returns the transform from map to truth with the smallest sum of min(distance, radius)^2 over
    the true objects. The distance is from a true object to its match, and infinite without a match.

    Args:
        source, target: map objects (N, 3) and true objects (M, 3) in m.
        same: (N, M), True if two objects may be the same.
        radius: maximum distance of a match in m.
        start: the only initial transform. If it is None, each pair of map objects is aligned with each pair of true objects
            with the same labels and a similar distance. For se3 and sim3, triples of objects replace the pairs. At most
            3,000 of these alignments (1,000 of triples) are sampled, with a fixed seed. The best 12 are initial transforms.
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
    """Return the best initial transforms. Each transform aligns two map objects with two true objects.

    For se3 and sim3, each transform aligns three objects. If no triple fits, pairs are aligned, and then single objects.
    """
    i, k = np.nonzero(same)
    if kind in ("se3", "sim3"):
        starts = _starts_in_space(source, target, i, k, radius, kind)
        if starts:
            return _cheapest(starts, source, target, same, radius)
    if len(i) <= _MAX_CORRESPONDENCES:
        first, second = np.triu_indices(len(i), 1)
    else:
        first, second = np.random.default_rng(0).integers(len(i), size=(_DRAWN_PAIRS, 2)).T
    distinct = (i[first] != i[second]) & (k[first] != k[second])
    first, second = first[distinct], second[distinct]
    a, b = source[i[second], :2] - source[i[first], :2], target[k[second], :2] - target[k[first], :2]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    likely = np.minimum(length_a, length_b) > 1e-9
    if kind in ("se2", "se3"):
        likely &= np.abs(length_a - length_b) <= 2 * radius
    else:
        likely &= (length_a * _SCALES[0] <= length_b) & (length_b <= length_a * _SCALES[1])
    chosen = np.flatnonzero(likely)
    if len(chosen) > _MAX_STARTS:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, _MAX_STARTS, replace=False))
    if len(chosen) == 0:  # Without a consistent pair, each start aligns one object.
        return [Transform(*align(source[[i[c]]], target[[k[c]]], kind)) for c in range(min(len(i), _MAX_REFINED))]
    first, second, a, b = first[chosen], second[chosen], a[chosen], b[chosen]
    yaw = np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(a[:, 1], a[:, 0])
    scale = length_b[chosen] / length_a[chosen] if kind in ("sim2", "sim3") else np.ones(len(chosen))
    poses = lift_se2(np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=-1))
    middle_a = (source[i[first]] + source[i[second]]) / 2
    middle_b = (target[k[first]] + target[k[second]]) / 2
    poses[:, :3, 3] = middle_b - scale[:, None] * np.einsum("hij,hj->hi", poses[:, :3, :3], middle_a)
    starts = [Transform(pose, float(s)) for pose, s in zip(poses, scale, strict=True)]
    return _cheapest(starts, source, target, same, radius)


def _starts_in_space(source: Floats, target: Floats, i: Ints, k: Ints, radius: float, kind: Alignment) -> list[Transform]:
    """Return alignments of three map objects with three true objects. The list is empty if no triple fits.

    i, k: the indices of the map object and of the true object of each correspondence. Each transform aligns a triangle with
    a triangle. Three objects on a line form no triangle.
    """
    rng = np.random.default_rng(0)
    if len(i) <= _MAX_TRIPLED:
        drawn = np.array(list(combinations(range(len(i)), 3)), dtype=np.int64).reshape(-1, 3)
    else:
        drawn = rng.integers(len(i), size=(_DRAWN_PAIRS, 3))
    a, b = source[i[drawn]], target[k[drawn]]  # (T, 3, 3): the corners of each triangle in the map and in the truth.
    along_a, along_b = (np.roll(corners, -1, axis=1) - corners for corners in (a, b))
    side_a, side_b = (np.sqrt(np.einsum("tci,tci->tc", along, along)) for along in (along_a, along_b))
    long_a, long_b = side_a.sum(axis=1), side_b.sum(axis=1)
    likely = np.minimum(side_a, side_b).min(axis=1, initial=np.inf) > 1e-9  # A sampled triple may hold an object twice.
    scale = np.ones(len(a)) if kind == "se3" else long_b / np.maximum(long_a, 1e-9)
    likely &= (scale >= _SCALES[0]) & (scale <= _SCALES[1])
    likely &= (np.abs(scale[:, None] * side_a - side_b) <= 2 * radius).all(axis=1)
    chosen = np.flatnonzero(likely)
    frame_a, frame_b = _frames(a[chosen]), _frames(b[chosen])
    corners = np.isfinite(frame_a).all(axis=(1, 2)) & np.isfinite(frame_b).all(axis=(1, 2))
    chosen, frame_a, frame_b = chosen[corners], frame_a[corners], frame_b[corners]
    if len(chosen) > _MAX_TRIPLES:
        kept = np.sort(rng.choice(len(chosen), _MAX_TRIPLES, replace=False))
        chosen, frame_a, frame_b = chosen[kept], frame_a[kept], frame_b[kept]
    rotation = frame_b @ np.swapaxes(frame_a, 1, 2)
    turned = np.einsum("h,hij,hj->hi", scale[chosen], rotation, a[chosen].mean(axis=1))
    poses = make_pose(rotation, b[chosen].mean(axis=1) - turned)
    return [Transform(pose, float(s)) for pose, s in zip(poses, scale[chosen], strict=True)]


def _frames(corners: Floats) -> Floats:
    """Return right-handed axes (T, 3, 3) of triangles (T, 3, 3). The axes are NaN if the corners are on a line."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    length = np.linalg.norm(normal, axis=1)
    flat = length <= _ON_A_LINE * np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        x, z = first / np.linalg.norm(first, axis=1, keepdims=True), normal / length[:, None]
    frames = np.stack([x, np.cross(z, x), z], axis=2)
    frames[flat] = np.nan
    return frames


def _cheapest(starts: list[Transform], source: Floats, target: Floats, same: Bools, radius: float) -> list[Transform]:
    at_once = max(1, _DISTANCES // int(same.sum()))
    costs = [_nearest_costs(starts[h : h + at_once], source, target, same, radius) for h in range(0, len(starts), at_once)]
    return [starts[h] for h in np.argsort(np.concatenate(costs), kind="stable")[:_MAX_REFINED]]


def _nearest_costs(starts: list[Transform], source: Floats, target: Floats, same: Bools, radius: float) -> Floats:
    """Return the cost (S,) of each start: the sum of min(distance, radius)^2 over the true objects, m^2.

    The distance is from a true object to the nearest map object that may match it. The caller ensures that at least one pair
    may match.
    """
    k, i = np.nonzero(same.T)  # Sorted by true object.
    moved = np.stack([start.apply(source) for start in starts])
    squared = sum((moved[:, i, axis] - target[k, axis]) ** 2 for axis in range(3))
    matched, first = np.unique(k, return_index=True)
    nearest = np.full((len(starts), len(target)), radius**2)
    nearest[:, matched] = np.minimum(np.minimum.reduceat(squared, first, axis=1), radius**2)
    return np.asarray(nearest.sum(axis=1))


def lay_truth(objects: ObjectMap, truth: Truth) -> Truth:
    """Return the ground truth in the coordinate frame of the map, so that both can be drawn together.

    A map from odometry without localisation has its own frame. The truth is aligned with the map in the plane if fewer than
    half of the possible matches are within 0.5 m and the alignment adds matches. If not, the truth is returned unchanged.
    """
    radius = 0.5
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
