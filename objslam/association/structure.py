"""One object or two? Decided by what explains the rays, the frames in which both were seen, and the misses more cheaply."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.association.evidence import Rates
from objslam.association.extent import grouped_median
from objslam.association.labels import SIZE_RATIO
from objslam.association.landmarks import BEHIND, State, blurs, offsets, range_costs, sizes, variance
from objslam.association.matches import gated_edges
from objslam.association.refit import refit
from objslam.association.sightings import Sightings
from objslam.association.visibility import Visits
from objslam.types import Bools, Floats, Ints

RAYLEIGH_MEDIAN = 1.1774
"""The median norm of a standard Gaussian in the plane."""
_OBJECT_COST = 10.0  # squared deviations that one more object costs, besides ln of the rays for each coordinate (BIC)
_INSIDE = (0.35, 0.5)  # of the size of the smaller, of the larger: things closer than that share their space,
_APART = 0.1  # unless they were seen as two in this share of the frames in which they could have been
_EXPECTED = 5.0  # frames with both that two things should have, for their absence to say something
_DUPLICATE = 0.5  # boxes of one frame that overlap as much (intersection over union) are of one thing
_NEIGHBOURS = 8
_REACH = 2.0  # gates: rays seen under little parallax put one thing at two distances


@dataclass(frozen=True)
class _Pairs:
    """Pairs of objects: a < b (P,), and their rays: ray (Q,), pair (Q,)."""

    a: Ints
    b: Ints
    ray: Ints
    pair: Ints

    def __len__(self) -> int:
        return len(self.a)


def merges(s: Sightings, state: State, kind: Ints, visits: Visits, rates: Rates, gate: float, across_labels: bool) -> Ints:
    """The object (N,) that each object is to be part of: itself, or the one with more rays of a pair that is one thing.

    across_labels: pairs of different labels instead of those of one label.
    """
    count, number = len(state.landmarks), state.number
    target = np.arange(count)
    diameter = sizes(s, state)
    a, b = _close(s, state, diameter, gate)
    wanted = (kind[a] == kind[b]) != across_labels
    a, b = a[wanted], b[wanted]
    if len(a) == 0:
        return target
    pairs = _with_rays(a, b, state)
    gain = _gains(s, state, kind, visits, rates, gate, pairs)
    apart = _seen_apart(s, pairs, state.matched)
    should = _expected_together(visits, a, b)
    gap = np.linalg.norm(state.landmarks.position[a] - state.landmarks.position[b], axis=1)
    small, large = np.minimum(diameter[a], diameter[b]), np.maximum(diameter[a], diameter[b])
    never = apart <= _APART * np.minimum(number[a], number[b])
    shared = (gap < _INSIDE[0] * small) & never
    shared |= (gap < _INSIDE[1] * large) & (apart <= _APART * np.maximum(should, _EXPECTED))
    one = (gain > 0) | shared
    if across_labels:
        one &= never & (large < SIZE_RATIO * small)
    taken = np.zeros(count, dtype=bool)
    for p in np.lexsort((b, a, -gain)):  # the clearest first, each object in one pair at a time
        if one[p] and not taken[a[p]] and not taken[b[p]]:
            taken[[a[p], b[p]]] = True
            keep, gone = (a[p], b[p]) if number[a[p]] >= number[b[p]] else (b[p], a[p])
            target[gone] = keep
    return target


def close_pairs(s: Sightings, state: State, gate: float) -> tuple[Ints, Ints]:
    """Pairs of landmarks a < b (P,) that could be one: within reach of each other's rays, within their size, in one line."""
    return _close(s, state, sizes(s, state), gate)


def _close(s: Sightings, state: State, diameter: Floats, gate: float) -> tuple[Ints, Ints]:
    from scipy.spatial import cKDTree

    count, position = len(state.landmarks), state.landmarks.position
    near = min(_NEIGHBOURS + 1, count)
    gap, other = (np.asarray(found).ravel() for found in cKDTree(position).query(position, k=np.arange(1, near + 1)))
    a, b = np.repeat(np.arange(count), near), other
    blur = blurs(s, state)
    reach = np.maximum(_REACH * np.sqrt(gate) * (blur[a] + blur[b]), 0.5 * (diameter[a] + diameter[b]))
    close = (gap < reach) & (a != b)
    c, d = _on_one_line(s, state, gate)
    pairs = np.stack([np.append(a[close], c), np.append(b[close], d)], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _on_one_line(s: Sightings, state: State, gate: float) -> tuple[Ints, Ints]:
    """Pairs (P,) where half of the rays of the first pass the second too: one thing under little parallax, or a ghost."""
    edges = gated_edges(s, state.landmarks, gate)
    own = state.matched[edges.ray]
    other = (own >= 0) & (own != edges.landmark)
    count = len(state.landmarks)
    pairs, shared = np.unique(own[other] * count + edges.landmark[other], return_counts=True)
    first, second = pairs // count, pairs % count
    half = 2 * shared >= state.number[first]
    return first[half], second[half]


def _with_rays(a: Ints, b: Ints, state: State) -> _Pairs:
    count = len(state.landmarks)
    order = np.argsort(state.matched, kind="stable")
    begin, end = (np.searchsorted(state.matched[order], np.arange(count), side=side) for side in ("left", "right"))
    which = np.stack([a, b], axis=1).ravel()
    length = (end - begin)[which]
    step = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    ray = order[np.repeat(begin[which], length) + step]
    return _Pairs(a, b, ray, np.repeat(np.arange(len(a)).repeat(2), length))


def _gains(s: Sightings, state: State, kind: Ints, visits: Visits, rates: Rates, gate: float, pairs: _Pairs) -> Floats:
    """What one object saves over two (P,), -2 ln likelihood: fit, boxes that only two explain, misses, the object itself."""
    count, a, b, number = len(pairs), pairs.a, pairs.b, state.number.astype(float)
    position, noise = state.landmarks.position, state.landmarks.noise
    r, own = s.take(pairs.ray), state.matched[pairs.ray]
    two = _ray_costs(r, position[own], noise[own], gate)
    share = (number[a] / (number[a] + number[b]))[:, None]
    wider = np.maximum(noise[a], noise[b])
    middle = refit(s, pairs.ray, pairs.pair, share * position[a] + (1 - share) * position[b], wider)
    off2, distance = offsets(r, middle[pairs.pair])
    deviation = np.minimum(np.sqrt(off2 / variance(r, distance, np.ones(len(r)))), BEHIND)
    joint = np.maximum(grouped_median(deviation, pairs.pair, count) / RAYLEIGH_MEDIAN, np.minimum(noise[a], noise[b]))
    one = _ray_costs(r, middle[pairs.pair], joint[pairs.pair], gate)

    order = np.lexsort((one, r.frame, pairs.pair))
    again = np.flatnonzero((np.diff(pairs.pair[order]) == 0) & (np.diff(r.frame[order]) == 0)) + 1
    second, first = order[again], order[again - 1]
    duplicate = overlap(r.box[second], r.box[first]) >= _DUPLICATE  # a second box of the same thing is no news
    one[second] = np.where(duplicate, 0.0, gate)
    two[second] = np.where(duplicate, 0.0, two[second])
    saved = np.bincount(pairs.pair, two - one, count) + _OBJECT_COST + 3 * np.log(number[a] + number[b])
    misses = rates.cost(visits.seen, visits.expected, kind)
    stronger = np.where(number[a] >= number[b], kind[a], kind[b])
    seen, expected = _in_either(visits, visits.detected, a, b), _in_either(visits, None, a, b)
    return np.asarray(saved + misses[a] + misses[b] - rates.cost(seen, expected, stronger))


def _ray_costs(r: Sightings, position: Floats, noise: Floats, gate: float) -> Floats:
    """-2 ln likelihood of each ray (R,) given its point, up to a constant; never more than that of a stray."""
    off2, distance = offsets(r, position)
    return np.minimum(off2 / variance(r, distance, noise) + 4 * np.log(noise) + range_costs(r, distance), gate)


def _table(visits: Visits, which: Bools | None) -> Any:
    """A sparse matrix (N, F) with 1 where the visits `which` (V,) are, or all of them."""
    from scipy.sparse import csr_array

    obj, frame = (visits.object, visits.frame) if which is None else (visits.object[which], visits.frame[which])
    return csr_array((np.ones(len(obj)), (obj, frame)), shape=(visits.count, int(visits.frame.max(initial=0)) + 1))


def _in_either(visits: Visits, which: Bools | None, a: Ints, b: Ints) -> Ints:
    """In how many frames (P,) of the visits `which` there is object a or object b."""
    table = _table(visits, which)
    both, each = table[a].multiply(table[b]).sum(axis=1), np.asarray(table.sum(axis=1)).ravel()
    return np.rint(each[a] + each[b] - np.asarray(both).ravel()).astype(np.int64)


def _expected_together(visits: Visits, a: Ints, b: Ints) -> Floats:
    """In how many frames (P,) two things should have been detected both, had they been detected independently."""
    every, seen = _table(visits, None), _table(visits, visits.detected)
    both, of_a, of_b = (
        np.asarray(one[a].multiply(other[b]).sum(axis=1)).ravel()
        for one, other in ((every, every), (seen, every), (every, seen))
    )
    return np.asarray(of_a * of_b / np.maximum(both, 1.0))


def _seen_apart(s: Sightings, pairs: _Pairs, matched: Ints) -> Ints:
    """In how many frames (P,) the two had a box each that were not of one thing."""
    order = np.lexsort((matched[pairs.ray], s.frame[pairs.ray], pairs.pair))
    ray, pair = pairs.ray[order], pairs.pair[order]
    both = np.flatnonzero((np.diff(pair) == 0) & (np.diff(s.frame[ray]) == 0))
    different = overlap(s.box[ray[both]], s.box[ray[both + 1]]) < _DUPLICATE
    return np.bincount(pair[both[different]], minlength=len(pairs))


def overlap(one: Floats, two: Floats) -> Floats:
    """Intersection over union (B,) of boxes (B, 4)."""
    low, high = np.maximum(one[:, :2], two[:, :2]), np.minimum(one[:, 2:], two[:, 2:])
    common = np.maximum(high - low, 0.0).prod(axis=1)
    total = (one[:, 2:] - one[:, :2]).prod(axis=1) + (two[:, 2:] - two[:, :2]).prod(axis=1) - common
    return np.asarray(common / np.maximum(total, 1e-12))
