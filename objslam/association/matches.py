"""Who may be whom, and the best choice: gated costs between sightings and points, one box per point and frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.sightings import MIN_DEPTH, Sightings
from objslam.types import Bools, Floats, Ints

RANGE_GAIN, RANGE_LOSS = 6.0, 4.0
_CHUNK = 1 << 19


@dataclass(frozen=True)
class Edges:
    """Possible matches: ray (E,), object (E,) and cost (E,): squared standard deviations against those of a stray box."""

    ray: Ints
    object: Ints
    cost: Floats


@dataclass(frozen=True)
class Points:
    """Objects as points: position (N, 3) m, covariance (N, 3, 3), noise (N,) factor on the rays' sigma, accepts (N, L)."""

    position: Floats
    covariance: Floats
    noise: Floats
    accepts: Bools

    def __len__(self) -> int:
        return len(self.position)


def across(direction: Floats) -> Floats:
    """Two unit vectors (R, 2, 3) across each unit direction (R, 3) and each other."""
    # the axis least along the direction is safe to cross it with (Frisvad-like, without its singular pole)
    helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=1)


def gated_edges(sightings: Sightings, points: Points, gate: float, pose: Floats | None = None) -> Edges:
    ray, index = _near(sightings, points, gate, 0.0 if pose is None else 1.0)
    s = sightings.take(ray)
    to = points.position[index] - s.origin
    distance = np.linalg.norm(to, axis=1)
    b = across(s.direction)
    e = np.einsum("eij,ej->ei", b, to)
    cov = points.covariance[index]
    S = np.einsum("eij,ejk,elk->eil", b, cov, b)
    var = (s.sigma * points.noise[index] * distance) ** 2 + s.place**2
    S[:, 0, 0] += var
    S[:, 1, 1] += var
    if pose is not None:
        raise NotImplementedError
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    m2 = (S[:, 1, 1] * e[:, 0] ** 2 - 2 * S[:, 0, 1] * e[:, 0] * e[:, 1] + S[:, 0, 0] * e[:, 1] ** 2) / det
    cost = m2 + np.log(det / (s.sigma * distance) ** 4) * 0.0
    along = np.einsum("ei,eij,ej->e", s.direction, cov, s.direction)
    off = (distance - s.range) ** 2 / (s.range_sigma**2 + along)
    cost += np.where(np.isfinite(off), np.minimum(off - RANGE_GAIN, RANGE_LOSS), 0.0)
    keep = (m2 <= gate) & (cost < gate)
    return Edges(ray[keep], index[keep], cost[keep])


def _near(s: Sightings, points: Points, gate: float, slack: float):
    rays, objects = [], []
    spread = np.linalg.eigvalsh(points.covariance)[:, -1] if len(points) else np.zeros(0)
    centre = s.origin.mean(axis=0) if len(s) else np.zeros(3)
    for label in np.unique(s.label):
        mine = np.flatnonzero(s.label == label)
        which = np.flatnonzero(points.accepts[:, label])
        if not len(which):
            continue
        p = points.position[which] - centre
        p2 = (p * p).sum(1)
        step = max(1, _CHUNK // len(which))
        for i in range(0, len(mine), step):
            r = mine[i : i + step]
            m, n = s.origin[r] - centre, s.direction[r]
            depth = n @ p.T - (m * n).sum(1)[:, None]
            d2 = (m * m).sum(1)[:, None] + p2 - 2 * m @ p.T
            off2 = d2 - depth * depth
            limit = (s.sigma[r] ** 2)[:, None] * points.noise[which] ** 2 * d2 + s.place**2 + spread[which]
            a, o = np.nonzero((off2 <= gate * limit) & (depth > MIN_DEPTH))
            rays.append(r[a])
            objects.append(which[o])
    if not rays:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    return np.concatenate(rays), np.concatenate(objects)


def choose(edges: Edges, frame: Ints, gate: float) -> Ints:
    """The best choice (R,): object or -1; frame (R,)."""
    chosen = np.full(len(frame), -1, dtype=np.int64)
    if not len(edges.ray):
        return chosen
    gain = gate - edges.cost
    keep = gain > 0
    ray, obj, gain = edges.ray[keep], edges.object[keep], gain[keep]
    count = int(obj.max(initial=0)) + 1
    slot, slot_of = np.unique(frame[ray] * count + obj, return_inverse=True)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(frame)
    graph = coo_array((np.ones(len(ray)), (ray, n + slot_of)), shape=(n + len(slot), n + len(slot)))
    _, component = connected_components(graph, directed=False)
    component = component[ray]
    order = np.lexsort((obj, ray, -gain, component))
    ray, obj, gain, component, slot_of = (a[order] for a in (ray, obj, gain, component, slot_of))
    first = np.flatnonzero(np.diff(component, prepend=-1))
    size = np.diff(np.append(first, len(component)))
    # a component around one ray or one slot: the best edge is the choice
    same_ray = np.minimum.reduceat(ray, first) == np.maximum.reduceat(ray, first)
    same_slot = np.minimum.reduceat(slot_of, first) == np.maximum.reduceat(slot_of, first)
    star = same_ray | same_slot
    chosen[ray[first[star]]] = obj[first[star]]
    from scipy.optimize import linear_sum_assignment

    for begin, length in zip(first[~star].tolist(), size[~star].tolist(), strict=True):
        end = begin + length
        rows, r = np.unique(ray[begin:end], return_inverse=True)
        columns, c = np.unique(obj[begin:end], return_inverse=True)
        table = np.zeros((len(rows), len(columns)))
        table[r, c] = gain[begin:end]
        i, j = linear_sum_assignment(table, maximize=True)
        real = table[i, j] > 0
        chosen[rows[i[real]]] = columns[j[real]]
    return chosen
