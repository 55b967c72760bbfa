"""Who may be whom, and the best choice: gated costs between sightings and landmarks, one box per landmark and frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.landmarks import Landmarks, range_costs, variance
from objslam.association.sightings import MIN_DEPTH, Sightings
from objslam.geometry import skew
from objslam.types import Floats, Ints

TRACK_GAIN = 2.0
"""What a match to the landmark of the other boxes of its track takes off the cost."""
_CHUNK = 1 << 19  # pairs of a ray and a landmark at a time
_FEW = 1 << 12  # pairs that are not worth a bound


@dataclass(frozen=True)
class Edges:
    """Possible matches, by ray and landmark in increasing order.

    ray, landmark: (E,). deviation: (E,) squared, in standard deviations of the bearing (2 degrees of freedom). vague: (E,)
    how much less a landmark of uncertain place says: the logarithm of the area that it covers over the ray's own. cost: (E,)
    all that together, with what the range says.
    """

    ray: Ints
    landmark: Ints
    deviation: Floats
    vague: Floats
    cost: Floats


def across(direction: Floats) -> Floats:
    """Two unit vectors (R, 2, 3) across each unit direction (R, 3) and each other."""
    turn = skew(direction)
    furthest = np.abs(direction).argmin(axis=1)  # the axis that is furthest from parallel
    axes = np.empty((len(direction), 2, 3))
    first = turn[np.arange(len(direction)), :, furthest]
    axes[:, 0] = first / np.sqrt((first * first).sum(axis=1))[:, None]
    axes[:, 1] = (turn @ axes[:, 0, :, None])[:, :, 0]
    return axes


def gated_edges(s: Sightings, landmarks: Landmarks, gate: float, pose: Floats | None = None) -> Edges:
    """All pairs of a ray and a landmark that accepts its label whose bearing lies within the gate (squared deviations).

    pose: (R, 6, 6) covariance of each ray's camera, rotation first, rotations about the map's axes (rad) and position (m).
    """
    ray, index = _near(s, landmarks, gate, pose)
    direction = s.direction[ray]
    to = landmarks.position[index] - s.origin[ray]
    distance = np.sqrt(np.einsum("ei,ei->e", to, to))
    axes = across(direction)
    x, y = np.einsum("eij,ej->ie", axes, to)
    covariance = landmarks.covariance[index]
    if pose is not None:
        covariance = covariance + _carried(to, pose[ray])
    spread = axes @ covariance @ np.swapaxes(axes, 1, 2)
    own = variance(s, distance, landmarks.noise[index], ray)
    a, b, c = spread[:, 0, 0] + own, spread[:, 0, 1], spread[:, 1, 1] + own
    determinant = a * c - b * b
    deviation = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    along = np.einsum("ei,eij,ej->e", direction, covariance, direction)
    vague = np.log(determinant / own**2)
    cost = deviation + vague + range_costs(s, distance, along, ray)
    keep = np.flatnonzero(deviation <= gate)
    keep = keep[np.lexsort((index[keep], ray[keep]))]
    return Edges(ray[keep], index[keep], deviation[keep], vague[keep], cost[keep])


def _carried(to: Floats, pose: Floats) -> Floats:
    """What the covariance of the cameras (E, 6, 6) makes of landmarks `to` (E, 3) away: (E, 3, 3)."""
    lever = skew(to)
    jacobian = np.concatenate([lever, np.broadcast_to(-np.eye(3), lever.shape)], axis=2)
    return np.asarray(jacobian @ pose @ np.swapaxes(jacobian, 1, 2))


def _near(s: Sightings, landmarks: Landmarks, gate: float, pose: Floats | None) -> tuple[Ints, Ints]:
    """Pairs that a bound on their deviation lets through; the bound takes matrix products only."""
    rays: list[Ints] = [np.zeros(0, dtype=np.int64)]
    found: list[Ints] = [np.zeros(0, dtype=np.int64)]
    if len(s) == 0 or len(landmarks) == 0:
        return rays[0], found[0]
    if len(s) * len(landmarks) <= _FEW:
        ray, index = np.nonzero(landmarks.accepts[:, s.label].T)
        ahead = np.einsum("ei,ei->e", landmarks.position[index] - s.origin[ray], s.direction[ray]) > MIN_DEPTH
        return ray[ahead], index[ahead]
    spread = np.linalg.eigvalsh(landmarks.covariance)[:, -1]
    turn: Floats = np.zeros(len(s))
    move: Floats = np.zeros(len(s))
    if pose is not None:  # twice each part bounds the two together with their correlation
        turn, move = (np.asarray(2 * np.linalg.eigvalsh(pose[:, i : i + 3, i : i + 3])[:, -1]) for i in (0, 3))
    centre = s.origin.mean(axis=0)
    for label in np.unique(s.label):
        mine, which = np.flatnonzero(s.label == label), np.flatnonzero(landmarks.accepts[:, label])
        p, noise2 = landmarks.position[which] - centre, landmarks.noise[which] ** 2
        p2 = (p * p).sum(axis=1)
        step = max(1, _CHUNK // max(len(which), 1))
        for begin in range(0, len(mine), step):
            r = mine[begin : begin + step]
            m, n = s.origin[r] - centre, s.direction[r]
            depth = n @ p.T - (m * n).sum(axis=1)[:, None]
            distance2 = (m * m).sum(axis=1)[:, None] + p2 - 2 * m @ p.T
            limit = distance2 * ((s.sigma[r] ** 2)[:, None] * noise2 + turn[r, None]) + s.place**2 * noise2
            limit += spread[which] + move[r, None] + 1e-9  # rounding of the products
            a, b = np.nonzero((distance2 - depth * depth <= gate * limit) & (depth > MIN_DEPTH))
            rays.append(r[a])
            found.append(which[b])
    return np.concatenate(rays), np.concatenate(found)


def choose(edges: Edges, cost: Floats, frame: Ints, unmatched: float) -> Ints:
    """The landmark of each ray (R,), -1 for none: at most one ray a landmark and frame, with the least total cost.

    cost: (E,) of the edges. frame: (R,). unmatched: what a ray without landmark costs. Frames are independent, and within
    them parts that share no ray and no landmark; only parts with a real conflict go to the Hungarian method.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    chosen = np.full(len(frame), -1, dtype=np.int64)
    useful = np.flatnonzero(cost < unmatched)
    if len(useful) == 0:
        return chosen
    ray, landmark, gain = edges.ray[useful], edges.landmark[useful], unmatched - cost[useful]
    places, place = np.unique(
        frame[ray] * (int(landmark.max()) + 1) + landmark, return_inverse=True
    )  # a landmark in a frame
    size = len(frame) + len(places)
    graph = coo_array((np.ones(len(ray)), (ray, len(frame) + place)), shape=(size, size))
    part = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)[ray]
    order = np.lexsort((landmark, ray, -gain, part))
    ray, landmark, gain, part, place = ray[order], landmark[order], gain[order], part[order], place[order]
    first = np.flatnonzero(np.diff(part, prepend=-1))
    end = np.append(first[1:], len(part))
    one_ray = np.minimum.reduceat(ray, first) == np.maximum.reduceat(ray, first)
    one_place = np.minimum.reduceat(place, first) == np.maximum.reduceat(place, first)
    simple = one_ray | one_place  # the best edge is the answer
    chosen[ray[first[simple]]] = landmark[first[simple]]
    for i, j in zip(first[~simple].tolist(), end[~simple].tolist(), strict=True):
        rows, r = np.unique(ray[i:j], return_inverse=True)
        columns, c = np.unique(landmark[i:j], return_inverse=True)
        table = np.zeros((len(rows), len(columns)))
        table[r, c] = gain[i:j]
        best = linear_sum_assignment(table, maximize=True)
        real = table[best] > 0
        chosen[rows[best[0][real]]] = columns[best[1][real]]
    return chosen


def track_bonus(edges: Edges, track: Ints, matched: Ints) -> Floats:
    """What tracks take off the cost of each edge (E,): where most other boxes of the ray's track are the landmark's.

    track, matched: (R,) the track of each ray, and its landmark as far as it is known (-1 none).
    """
    bonus = np.zeros(len(edges.ray))
    known = np.flatnonzero((track >= 0) & (matched >= 0))
    if len(known) == 0:
        return bonus
    base = int(matched.max()) + 1
    keys, counts = np.unique(track[known] * base + matched[known], return_counts=True)
    tracks, start = np.unique(keys // base, return_index=True)
    total = np.add.reduceat(counts, start)
    which = np.flatnonzero((track[edges.ray] >= 0) & (edges.landmark < base))
    ray, landmark = edges.ray[which], edges.landmark[which]
    at = np.minimum(np.searchsorted(keys, track[ray] * base + landmark), len(keys) - 1)
    same = keys[at] == track[ray] * base + landmark
    own = (matched[ray] == landmark).astype(np.int64)
    t = np.minimum(np.searchsorted(tracks, track[ray]), len(tracks) - 1)
    others = np.where(same, counts[at], 0) - own
    of = np.where(tracks[t] == track[ray], total[t], 0) - (matched[ray] >= 0)
    bonus[which] = np.where((others >= 2) & (2 * others > of), TRACK_GAIN, 0.0)
    return bonus
