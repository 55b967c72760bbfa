"""Whether two objects are one: what explains the rays, the frames with both of them and the misses more cheaply."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.association.existence import Rates, detection_rates
from objslam.association.gating import gated_edges
from objslam.association.label_fusion import SIZE_RATIO
from objslam.association.landmarks import State
from objslam.association.observations import Observations
from objslam.association.refinement import BEHIND, normalised_residuals, range_costs, refine, squared_offsets, variance
from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import RAYLEIGH_MEDIAN, grouped_median

_OBJECT_COST = 10.0  # The squared deviations that one more object costs, besides BIC's ln of the rays for each coordinate.
_SHARED_SPACE = (0.35, 0.5)  # The shares of the smaller size, and of the larger, within which two things fill one space.
_MOST_APART = 0.1  # The greatest share of frames, of the weaker one or expected with both, in which one may look like two.
_MIN_EXPECTED = 5.0  # The fewest frames in which two things should both be detected for their absence to say something.
_DUPLICATE_OVERLAP = 0.5  # The intersection over union of two boxes of one frame from which they show one thing.
_NEIGHBOURS = 8  # The nearest landmarks that each one is compared with; larger costs time where many stand close.
_REACH_GATES = 2.0  # The gates within which landmarks are compared: under little parallax one thing has two distances.


@dataclass(frozen=True)
class _Pairs:
    """Pairs of objects a < b (P,), and the rays (Q,) of both: ray and pair (Q,) are indices."""

    a: Ints
    b: Ints
    ray: Ints
    pair: Ints

    def __len__(self) -> int:
        return len(self.a)


def merge_targets(state: State, gate: float, across_labels: bool) -> Ints:
    """The object (N,) that each object becomes part of: itself, or the one with more rays where a pair is one thing.

    across_labels: compare pairs of different labels instead of pairs of one label.
    """
    obs, count, number, label, diameter = state.obs, state.count, state.ray_count, state.label, state.size
    target = np.arange(count)
    a, b = close_pairs(state, gate)
    wanted = (label[a] == label[b]) != across_labels
    a, b = a[wanted], b[wanted]
    if len(a) == 0:
        return target
    pairs = _with_rays(a, b, state)
    gain = _gains(state, detection_rates(state.history, label, len(state.unassigned)), gate, pairs)
    apart = _seen_apart(obs, pairs, state.matched)
    should = _expected_together(state.history, a, b)
    gap = np.linalg.norm(state.landmarks.position[a] - state.landmarks.position[b], axis=1)
    small, large = np.minimum(diameter[a], diameter[b]), np.maximum(diameter[a], diameter[b])
    never = apart <= _MOST_APART * np.minimum(number[a], number[b])
    shared = (gap < _SHARED_SPACE[0] * small) & never
    shared |= (gap < _SHARED_SPACE[1] * large) & (apart <= _MOST_APART * np.maximum(should, _MIN_EXPECTED))
    one = (gain > 0) | shared
    if across_labels:
        one &= never & (large < SIZE_RATIO * small)
    taken = np.zeros(count, dtype=bool)
    for p in np.lexsort((b, a, -gain)):  # the clearest pair first; an object takes part in one
        if one[p] and not taken[a[p]] and not taken[b[p]]:
            taken[[a[p], b[p]]] = True
            keep, gone = (a[p], b[p]) if number[a[p]] >= number[b[p]] else (b[p], a[p])
            target[gone] = keep
    return target


def close_pairs(state: State, gate: float) -> tuple[Ints, Ints]:
    """Pairs of landmarks a < b (P,) that could be one: near for their rays or their sizes, or on one line of sight."""
    from scipy.spatial import cKDTree

    count, position, diameter = state.count, state.landmarks.position, state.size
    near = min(_NEIGHBOURS + 1, count)
    gap, other = (np.asarray(found).ravel() for found in cKDTree(position).query(position, k=np.arange(1, near + 1)))
    a, b = np.repeat(np.arange(count), near), other
    reach = np.maximum(
        _REACH_GATES * np.sqrt(gate) * (state.ray_sigma[a] + state.ray_sigma[b]), 0.5 * (diameter[a] + diameter[b])
    )
    close = (gap < reach) & (a != b)
    c, d = _on_one_line(state, gate)
    pairs = np.stack([np.append(a[close], c), np.append(b[close], d)], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _on_one_line(state: State, gate: float) -> tuple[Ints, Ints]:
    """Pairs (P,) where half of the first one's rays pass the second too: one thing under little parallax, or a ghost."""
    edges = gated_edges(state.obs, state.landmarks, gate)
    own = state.matched[edges.ray]
    other = (own >= 0) & (own != edges.landmark)
    pairs, shared = np.unique(own[other] * state.count + edges.landmark[other], return_counts=True)
    first, second = pairs // state.count, pairs % state.count
    half = 2 * shared >= state.ray_count[first]
    return first[half], second[half]


def _with_rays(a: Ints, b: Ints, state: State) -> _Pairs:
    order = np.argsort(state.matched, kind="stable")
    begin, end = (np.searchsorted(state.matched[order], np.arange(state.count), side=side) for side in ("left", "right"))
    which = np.stack([a, b], axis=1).ravel()
    length = (end - begin)[which]
    step = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    ray = order[np.repeat(begin[which], length) + step]
    return _Pairs(a, b, ray, np.repeat(np.arange(len(a)).repeat(2), length))


def _gains(state: State, rates: Rates, gate: float, pairs: _Pairs) -> Floats:
    """The -2 ln likelihood (P,) that one object saves over two: fit, boxes only two explain, misses, the object itself."""
    count, a, b, number = len(pairs), pairs.a, pairs.b, state.ray_count.astype(float)
    obs, history, position, noise = state.obs, state.history, state.landmarks.position, state.landmarks.noise
    r, own = obs.take(pairs.ray), state.matched[pairs.ray]
    two = _ray_costs(r, position[own], noise[own], gate)
    share = (number[a] / (number[a] + number[b]))[:, None]
    wider = np.maximum(noise[a], noise[b])
    middle = refine(obs, pairs.ray, pairs.pair, share * position[a] + (1 - share) * position[b], wider)
    deviation = np.minimum(normalised_residuals(r, middle[pairs.pair]), BEHIND)
    joint = np.maximum(grouped_median(deviation, pairs.pair, count) / RAYLEIGH_MEDIAN, np.minimum(noise[a], noise[b]))
    one = _ray_costs(r, middle[pairs.pair], joint[pairs.pair], gate)

    order = np.lexsort((one, r.frame, pairs.pair))
    again = np.flatnonzero((np.diff(pairs.pair[order]) == 0) & (np.diff(r.frame[order]) == 0)) + 1
    second, first = order[again], order[again - 1]
    duplicate = overlap(r.box[second], r.box[first]) >= _DUPLICATE_OVERLAP  # a second box of one thing tells nothing new
    one[second] = np.where(duplicate, 0.0, gate)
    two[second] = np.where(duplicate, 0.0, two[second])
    saved = np.bincount(pairs.pair, two - one, count) + _OBJECT_COST + 3 * np.log(number[a] + number[b])
    misses = rates.cost(history.seen, history.expected, state.label)
    stronger = np.where(number[a] >= number[b], state.label[a], state.label[b])
    seen, expected = _in_either(history, history.detected, a, b), _in_either(history, None, a, b)
    return np.asarray(saved + misses[a] + misses[b] - rates.cost(seen, expected, stronger))


def _ray_costs(r: Observations, position: Floats, noise: Floats, gate: float) -> Floats:
    """-2 ln likelihood of each ray (R,) given its point, up to a constant; at most that of a stray."""
    off2, distance = squared_offsets(r, position)
    return np.minimum(off2 / variance(r, distance, noise) + 4 * np.log(noise) + range_costs(r, distance), gate)


def _table(history: DetectionHistory, which: Bools | None) -> Any:
    """A sparse matrix (N, F) with 1 at the pairs `which` (V,) of a history, or at all of them."""
    from scipy.sparse import csr_array

    obj, frame = (history.object, history.frame) if which is None else (history.object[which], history.frame[which])
    return csr_array((np.ones(len(obj)), (obj, frame)), shape=(len(history.inside), int(history.frame.max(initial=0)) + 1))


def _in_either(history: DetectionHistory, which: Bools | None, a: Ints, b: Ints) -> Ints:
    """Frames (P,) with object a or object b among the pairs `which` of a history."""
    table = _table(history, which)
    both, each = table[a].multiply(table[b]).sum(axis=1), np.asarray(table.sum(axis=1)).ravel()
    return np.rint(each[a] + each[b] - np.asarray(both).ravel()).astype(np.int64)


def _expected_together(history: DetectionHistory, a: Ints, b: Ints) -> Floats:
    """Frames (P,) in which two things should both have been detected, if they are detected independently."""
    every, seen = _table(history, None), _table(history, history.detected)
    both, of_a, of_b = (
        np.asarray(one[a].multiply(other[b]).sum(axis=1)).ravel()
        for one, other in ((every, every), (seen, every), (every, seen))
    )
    return np.asarray(of_a * of_b / np.maximum(both, 1.0))


def _seen_apart(obs: Observations, pairs: _Pairs, matched: Ints) -> Ints:
    """Frames (P,) in which each of the two had a box, and the boxes hardly overlap."""
    order = np.lexsort((matched[pairs.ray], obs.frame[pairs.ray], pairs.pair))
    ray, pair = pairs.ray[order], pairs.pair[order]
    both = np.flatnonzero((np.diff(pair) == 0) & (np.diff(obs.frame[ray]) == 0))
    different = overlap(obs.box[ray[both]], obs.box[ray[both + 1]]) < _DUPLICATE_OVERLAP
    return np.bincount(pair[both[different]], minlength=len(pairs))


def overlap(one: Floats, two: Floats) -> Floats:
    """Intersection over union (B,) of boxes (B, 4)."""
    low, high = np.maximum(one[:, :2], two[:, :2]), np.minimum(one[:, 2:], two[:, 2:])
    common = np.maximum(high - low, 0.0).prod(axis=1)
    total = (one[:, 2:] - one[:, :2]).prod(axis=1) + (two[:, 2:] - two[:, :2]).prod(axis=1) - common
    return np.asarray(common / np.maximum(total, 1e-12))
