"""Decide whether two landmarks are one object: compare the cost of both explanations of their rays, frames and misses."""

from dataclasses import dataclass

import numpy as np

from objslam.association.duplicates import show_one_thing
from objslam.association.existence import rates_of_classes
from objslam.association.gating import gated_edges
from objslam.association.label_fusion import SIZE_RATIO
from objslam.association.landmarks import State
from objslam.association.observations import Observations, overlap
from objslam.association.refinement import BEHIND, normalised_residuals, ray_costs, refine
from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import nearest_points
from objslam.core.statistics import RAYLEIGH_MEDIAN, grouped_median

_OBJECT_COST = 10.0
"""The cost of one more object in squared deviations. BIC's cost, ln of the number of rays for each coordinate, is added."""
_SHARED_SPACE = (0.35, 0.5)
"""The largest distances of two landmarks that fill one space. The first is a share of the smaller size, and the second is a
share of the larger size. A distance below either limit is enough. Larger shares merge more landmarks."""
_MOST_APART = 0.1
"""The largest share of frames in which one object may look like two. It is a share of the rarer landmark's rays, of the
frames that should show both landmarks, or of the frames with boxes of both. A larger share merges more landmarks."""
_OFTEN = 5
"""One of two landmarks has second boxes of the other only if at least this number of frames have boxes of both. Nearly all
such pairs of boxes must lie on each other, and the landmarks must be nearer than the smaller size. Things do not go through
each other. A larger number leaves second boxes in short logs."""
_MIN_EXPECTED = 5.0
"""The least number of frames that are assumed to show both landmarks if detections are independent. A larger number merges
more landmarks."""
_DUPLICATE_OVERLAP = 0.5
"""If two boxes in one frame have at least this intersection over union, the second box is no evidence for a second object.
With a smaller value, two neighbours whose boxes overlap in many frames become one object."""
_NEIGHBOURS = 8  # The number of nearest landmarks that each one is compared with. A larger value costs time in dense scenes.
_REACH_GATES = 2.0
"""The distance up to which two landmarks are compared, in gates of the noise of their rays. This distance is large because
one object with little parallax may get landmarks at two distances. A larger value takes longer."""


@dataclass(frozen=True)
class _Pairs:
    """P pairs of landmarks a < b, and the rays of all pairs in one flat list of Q rays. a, b: (P,) the landmarks. ray, pair:
    (Q,) the index of each ray, and of its pair. For each pair, the rays of a come before the rays of b. A ray is in the list
    once for each pair of its landmark."""

    a: Ints
    b: Ints
    ray: Ints
    pair: Ints


def merge_targets(state: State, gate: float, across_labels: bool) -> Ints:
    """Return the landmark (N,) into which each landmark merges: itself, or the landmark with more rays if a pair is one
    object.

    across_labels: compare pairs of different labels instead of pairs with one label.
    """
    obs, count, number, label, diameter = state.obs, state.count, state.ray_count, state.label, state.size
    target = np.arange(count)
    a, b = close_pairs(state, gate)
    wanted = (label[a] == label[b]) != across_labels
    a, b = a[wanted], b[wanted]
    if len(a) == 0:
        return target
    pairs = _with_rays(a, b, state)
    both_seen, both_expected, seen_a, seen_b = common_frames(state.history, a, b)
    gain = _gains(state, gate, pairs, both_seen, both_expected)
    together, apart = _seen_together(obs, pairs, state.matched)
    should = seen_a * seen_b / np.maximum(both_expected, 1.0)  # The frames with both, if detections are independent.
    gap = np.linalg.norm(state.landmarks.position[a] - state.landmarks.position[b], axis=1)
    small, large = np.minimum(diameter[a], diameter[b]), np.maximum(diameter[a], diameter[b])
    never = apart <= _MOST_APART * np.minimum(number[a], number[b])
    shared = (gap < _SHARED_SPACE[0] * small) & never
    shared |= (gap < _SHARED_SPACE[1] * large) & (apart <= _MOST_APART * np.maximum(should, _MIN_EXPECTED))
    shared |= (gap < small) & (together >= _OFTEN) & (apart <= _MOST_APART * together)
    one = (gain > 0) | shared
    if across_labels:
        one &= never & (large < SIZE_RATIO * small)
    taken = np.zeros(count, dtype=bool)
    for p in np.lexsort((b, a, -gain)):  # The pair with the largest gain comes first. Each landmark merges at most once.
        if one[p] and not taken[a[p]] and not taken[b[p]]:
            taken[[a[p], b[p]]] = True
            target[[a[p], b[p]]] = a[p] if number[a[p]] >= number[b[p]] else b[p]
    return target


def close_pairs(state: State, gate: float) -> tuple[Ints, Ints]:
    """Return the pairs of landmarks a < b (P,) that may be one object. Two landmarks of a pair lie on one line of sight, or
    their distance is small beside the noise of their rays or their sizes."""
    count, position = state.count, state.landmarks.position
    b = nearest_points(position, min(_NEIGHBOURS + 1, count)).ravel()
    a = np.repeat(np.arange(count), len(b) // max(count, 1))
    gap = np.linalg.norm(position[a] - position[b], axis=1)
    by_rays = _REACH_GATES * np.sqrt(gate) * (state.ray_sigma[a] + state.ray_sigma[b])
    close = (gap < np.maximum(by_rays, 0.5 * (state.size[a] + state.size[b]))) & (a != b)
    pairs = np.concatenate([np.stack([a[close], b[close]], axis=1), _on_one_line(state, gate)])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def better_neighbours(state: State, failing: Bools, gate: float) -> Bools:
    """Return which landmarks (N,) have more rays than a neighbour of the same label, if both of them fail. Such a landmark
    may get the rays of its neighbour. With these rays, it may pass.

    failing: (N,) the landmarks that fail a test.
    """
    number, label, better = state.ray_count, state.label, np.zeros(state.count, dtype=bool)
    a, b = close_pairs(state, gate)
    rivals = failing[a] & failing[b] & (label[a] == label[b])
    better[np.where(number[a] > number[b], a, b)[rivals]] = True
    return better


def _on_one_line(state: State, gate: float) -> Ints:
    """Return the pairs (P, 2) in which at least half of the first landmark's rays also pass the second landmark. This
    happens with little parallax, or if one of the landmarks is a phantom."""
    edges = gated_edges(state.obs, state.landmarks, gate)
    own = state.matched[edges.ray]
    other = (own >= 0) & (own != edges.landmark)
    pairs, shared = np.unique(own[other] * state.count + edges.landmark[other], return_counts=True)
    first, second = pairs // state.count, pairs % state.count
    return np.stack([first, second], axis=1)[2 * shared >= state.ray_count[first]]


def _with_rays(a: Ints, b: Ints, state: State) -> _Pairs:
    order = np.argsort(state.matched, kind="stable")
    begin, end = (np.searchsorted(state.matched[order], np.arange(state.count), side=side) for side in ("left", "right"))
    which = np.stack([a, b], axis=1).ravel()
    length = (end - begin)[which]
    step = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    ray = order[np.repeat(begin[which], length) + step]
    return _Pairs(a, b, ray, np.repeat(np.arange(len(a)).repeat(2), length))


def _gains(state: State, gate: float, pairs: _Pairs, both_seen: Ints, both_expected: Ints) -> Floats:
    """Return the decrease (P,) of -2 ln likelihood by one object instead of two.

    It counts the fit of the rays, second boxes in one frame, missed detections, the appearance, and the number of objects.
    both_seen, both_expected: (P,) the numbers of frames in which both landmarks are detected, and in which both should be
    detected.
    """
    count, a, b, number = len(pairs.a), pairs.a, pairs.b, state.ray_count.astype(float)
    obs, history, position, noise = state.obs, state.history, state.landmarks.position, state.landmarks.noise
    r, own = obs.take(pairs.ray), state.matched[pairs.ray]
    two = ray_costs(r, position[own], noise[own], gate)
    share = (number[a] / (number[a] + number[b]))[:, None]
    wider = np.maximum(noise[a], noise[b])
    middle = refine(obs, pairs.ray, pairs.pair, share * position[a] + (1 - share) * position[b], wider)
    deviation = np.minimum(normalised_residuals(r, middle[pairs.pair]), BEHIND)
    joint = np.maximum(grouped_median(deviation, pairs.pair, count) / RAYLEIGH_MEDIAN, np.minimum(noise[a], noise[b]))
    one = ray_costs(r, middle[pairs.pair], joint[pairs.pair], gate)

    order = np.lexsort((one, r.frame, pairs.pair))
    again = np.flatnonzero((np.diff(pairs.pair[order]) == 0) & (np.diff(r.frame[order]) == 0)) + 1
    second, first = order[again], order[again - 1]
    duplicate = overlap(r.box[second], r.box[first]) >= _DUPLICATE_OVERLAP  # A second box of one object adds no information.
    one[second] = np.where(duplicate, 0.0, gate)
    two[second] = np.where(duplicate, 0.0, two[second])
    saved = np.bincount(pairs.pair, two - one, count) + _OBJECT_COST + 3 * np.log(number[a] + number[b])
    if state.looks is not None:
        saved += 2 * state.looks.landmark_odds(a, b, state.label[a])
    rates = rates_of_classes(state)
    misses = rates.cost(history.seen, history.expected, state.label)
    stronger = np.where(number[a] >= number[b], state.label[a], state.label[b])
    seen = history.seen[a] + history.seen[b] - both_seen
    expected = history.expected[a] + history.expected[b] - both_expected
    return np.asarray(saved + misses[a] + misses[b] - rates.cost(seen, expected, stronger))


def common_frames(history: DetectionHistory, a: Ints, b: Ints) -> list[Ints]:
    """Return four counts (P,) of frames: both landmarks detected, both expected, a detected and b expected, a expected
    and b detected."""
    from scipy.sparse import csr_array

    shape = len(history.inside), int(history.frame.max(initial=0)) + 1
    seen, expected = (
        csr_array((np.ones(which.sum(), dtype=np.int64), (history.object[which], history.frame[which])), shape=shape)
        for which in (history.detected, np.ones_like(history.detected))
    )
    tables = ((seen, seen), (expected, expected), (seen, expected), (expected, seen))
    return [np.asarray(one[a].multiply(two[b]).sum(axis=1)).ravel() for one, two in tables]


def _seen_together(obs: Observations, pairs: _Pairs, matched: Ints) -> tuple[Ints, Ints]:
    """Return the number of frames (P,) in which both landmarks have a box, and the number of frames (P,) in which these two
    boxes do not lie on each other."""
    order = np.lexsort((matched[pairs.ray], obs.frame[pairs.ray], pairs.pair))
    ray, pair = pairs.ray[order], pairs.pair[order]
    both = np.flatnonzero((np.diff(pair) == 0) & (np.diff(obs.frame[ray]) == 0))
    different = ~show_one_thing(obs.box[ray[both]], obs.box[ray[both + 1]])
    return np.bincount(pair[both], minlength=len(pairs.a)), np.bincount(pair[both[different]], minlength=len(pairs.a))
