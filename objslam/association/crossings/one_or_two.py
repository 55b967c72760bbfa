"""Distinguish one thing from two things whose rays cross. In tracking by bearings, such a crossing is a ghost.

Rays from a short stretch of the path, a bundle, hardly show how far away their thing is. Two bundles in a plane always meet
somewhere. So two stretches that see two things give a landmark behind both, or between them, and all rays fit it. The
likelihood of all data of both bundles decides which explanation is right. The data are the bearings, the sizes of boxes,
their growth as the robot comes nearer, and whether the distances are usual for the class. The unknown positions are
integrated out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.crossings.bundles import COUNTED, TIGHTNESS, Bundles, second_bundle
from objslam.association.crossings.positions import FreeFit, fit_freely, fit_points, points_along
from objslam.association.crossings.usual_views import UsualViews
from objslam.association.gating import gated_edges
from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import STRAY_RAY

_GAP = np.radians(2.0)
"""The least gap (rad) between the two bundles of a landmark. Closer bundles are one stretch of the path. A smaller gap tests
more landmarks."""
_HIDDEN, _HIDDEN_WIDTH = 0.1, 4.6
"""`_HIDDEN` is the assumed share of views that show only a part of a thing. Their ln size has a uniform distribution of the
width `_HIDDEN_WIDTH`: a factor of 100 between the smallest and the largest size. With a larger share, or a smaller width, a
difference of sizes is weaker evidence."""
_CLEAR = 3.0
"""The least log odds of two things over one for a landmark that is split: 3 is a factor of 20. A larger value splits fewer
landmarks. A thing may be lost if it is split."""
_ASSUMED = 3
"""The number of landmarks that are assumed to have the usual gain (`_USUAL_GAIN`), in addition to the landmarks of the log.
With a larger number, errors that rays share split more landmarks."""
_LEAST_EXCESS = 1 / 16
"""The least factor on the usual gain of two points. Rays with a quarter of their nominal noise have this factor. A smaller
factor splits more landmarks."""
_OFF_CENTRE = 0.02
"""The offset between the middle of a thing and the middles of its boxes in one bundle, as a share of the boxes' size.
Perspective alone gives this share for a cube that is seen from six times its size. A larger share splits fewer large
things."""
_TRIES = 1
"""A landmark is not split again if its rays were in split landmarks this many times on average. The rays of some landmarks
come back after each split. In a drive between cones, 17 landmarks were split, some of them up to eight times. A larger
number takes longer."""
_FREE = 3
"""The degrees of freedom of a second point: its three coordinates."""
_USUAL_GAIN = 2.366
"""The median decrease of the cost of the rays of one thing if two points explain them instead of one. It is the median of
chi-squared with `_FREE` degrees of freedom."""
_USUAL_GAINS = ((0.5, _USUAL_GAIN), (0.8, 4.642))
"""Two probabilities, each with its quantile of chi-squared with `_FREE` degrees of freedom. Errors that last for a while,
such as the slip of a wheel, concern only some landmarks. Such errors show in the second quantile. The second quantile stays
the same if one landmark in five is two things."""


@dataclass(frozen=True)
class Crossings:
    """S landmarks whose rays come in two bundles.

    landmark: (S,). second: (R,) whether a ray is in the second bundle of its landmark. odds: (S,) log odds that the landmark
    is one thing. A positive value may be only a lower bound. position: (S, 2, 3) m, where the two things of the landmark
    would be.
    """

    landmark: Ints
    second: Bools
    odds: Floats
    position: Floats

    @property
    def two(self) -> Bools:
        """Whether each landmark (S,) is clearly two things."""
        return self.odds < -_CLEAR

    def untried(self, state: State, tries: Ints) -> Bools:
        """Return which landmarks (S,) are clearly two things and were not tried yet. The rays of such a landmark were in
        split landmarks fewer than `_TRIES` times on average.

        state: the state with the landmarks. tries: (R,) how often each ray was in a split landmark. The rays of the returned
        landmarks are counted in it.
        """
        number = np.bincount(state.owner, minlength=state.count)
        before = np.bincount(state.owner, tries[state.assigned], state.count) / np.maximum(number, 1)
        two = self.two & (before[self.landmark] < _TRIES)
        tries[state.assigned[np.isin(state.owner, self.landmark[two])]] += 1
        return np.asarray(two)


def find_crossings(state: State, sized: Bools, fewest: int) -> Crossings:
    """Compare one thing and two things as explanations of each landmark whose rays come in two bundles.

    The things of a class may lie anywhere in the mapped space, with the density of its landmarks. The second thing of a
    landmark may also be another landmark that fits the bundle's rays. Only bundles whose boxes have sizes are compared.
    Without sizes, only the bearings show how far away the thing is, and the rays of one stretch of the path share errors.

    sized: (R,) whether the camera of each ray observes sizes. fewest: the number of such boxes that a bundle must have.
    """
    second = np.zeros(len(state.obs), dtype=bool)
    told = (sized & (state.obs.size > 0).all(axis=1))[state.assigned]
    direction = state.obs.direction[state.assigned]
    second[state.assigned] = second_bundle(direction, state.owner, state.count, _GAP, told, fewest)
    two = np.flatnonzero(np.bincount(state.owner, second[state.assigned], state.count))
    if not len(two):
        return Crossings(two, second, np.zeros(0), np.zeros((0, 2, 3)))
    ray = state.assigned[np.isin(state.owner, two)]
    group = 2 * np.searchsorted(two, state.matched[ray]) + second[ray]
    number, landmark = np.bincount(group, minlength=2 * len(two)), np.repeat(two, 2)
    # The noise of the class counts, because the own noise of a landmark that is two things is too large.
    noise = state.class_noise[state.label[landmark]]
    bundles = Bundles(UsualViews.of(state, sized), ray, group, landmark, noise, np.minimum(number, COUNTED))
    one, one_cost = _as_one(bundles)
    free, free_cost = fit_freely(bundles)
    other, other_cost = _as_another(bundles)
    excess = np.maximum(excess_of(one_cost - free_cost.reshape(-1, 2).sum(axis=1)), _of_offsets(bundles))
    two_things = _as_two((_most(bundles, free), free_cost), (other, other_cost))
    odds = one - (two_things[0] + _bearing_odds(one_cost - two_things[1], excess, len(two))).max(axis=0)
    position, open_ = free.position.copy(), np.flatnonzero(odds < 0)
    if len(open_):  # Only `open_` can be two things. The trial of all distances takes most of the time.
        pair = (2 * open_[:, None] + np.arange(2)).ravel()
        alone, alone_cost, position[pair] = _alone(bundles.take(pair), free.take(pair))
        two_things = _as_two((alone, alone_cost), (other[pair], other_cost[pair]))
        better = _bearing_odds(one_cost[open_] - two_things[1], excess[open_], len(two))
        better[0, _overlap(bundles.take(pair), position[pair])] = -np.inf
        odds[open_] = one[open_] - (two_things[0] + better).max(axis=0)
    return Crossings(two, second, odds, position.reshape(-1, 2, 3))


def _as_two(alone: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return the log likelihoods (3, S) and the costs (3, S) of pairs of bundles that show two things.

    There are three cases: two new things, or a new thing and another landmark, in both orders. alone, other: the log
    likelihood (G,) and the cost (G,) of each bundle.
    """
    (a, b), (c, d) = alone[0].reshape(-1, 2).T, other[0].reshape(-1, 2).T
    (p, q), (r, s) = alone[1].reshape(-1, 2).T, other[1].reshape(-1, 2).T
    return np.array([a + b, a + d, c + b]), np.array([p + q, p + s, r + q])


def _most(bundles: Bundles, free: FreeFit) -> Floats:
    """Return the greatest log likelihood (G,), without the bearings, of each bundle if it shows a thing of its own."""
    usual, landmark = bundles.usual, bundles.landmark
    variance_ = usual.class_spread[landmark] ** 2 + usual.view**2
    size = np.maximum(_size_odds(usual.class_mean[landmark], usual.class_mean[landmark], variance_), 0.0)
    return usual.log_density[landmark] + free.log_volume - bundles.counted * np.log(TIGHTNESS) + size


def _overlap(bundles: Bundles, position: Floats) -> Bools:
    """Return for each pair (S,) of bundles whether the two things would overlap at the points (G, 3), m.

    Two real things do not overlap. But two points inside one large thing may explain its rays better than one point: the
    rays from two sides to the middles of its boxes do not meet in one point.
    """
    apart = np.linalg.norm(position[::2] - position[1::2], axis=1)
    return np.asarray(apart < np.exp(bundles.size(position)[0]).reshape(-1, 2).mean(axis=1))


def without_smaller_bundles(state: State, sized: Bools) -> State:
    """Return the state without the rays of the smaller bundle of each landmark that is two things. A single ray of another
    thing can give a landmark all its parallax. sized: as in `find_crossings`."""
    found = find_crossings(state, sized, fewest=1)
    mine = np.flatnonzero(np.isin(state.matched, found.landmark[found.two]))
    second = np.bincount(state.owner, found.second[state.assigned], state.count)
    smaller = found.second[mine] == (2 * second <= state.ray_count)[state.matched[mine]]
    matched = state.matched.copy()
    matched[mine[smaller]] = -1
    return replace(state, matched=matched)


def excess_of(gain: Floats) -> Floats:
    """Return for each landmark (S,) the factor by which two points usually gain more than the nominal noise explains.

    Rays share errors, such as errors of poses and clocks. Then two points fit the rays of one thing better than noise
    explains. Poses can also be better than their nominal noise. Then two points gain less, and a small misfit shows a second
    thing. The factor comes from the gains of the other landmarks. gain: (S,) by how much two free points lower the cost.
    """
    every = np.append(gain, np.full(_ASSUMED, _USUAL_GAIN))
    order = np.argsort(every, kind="stable")
    rank = np.argsort(order, kind="stable")[: len(gain)]
    found = np.full(len(gain), _LEAST_EXCESS)
    for quantile, usual in _USUAL_GAINS:
        at = quantile * (len(every) - 2)
        low, high = int(at), int(np.ceil(at))
        # Without a landmark's own gain, all gains behind it move one place ahead.
        below, above = (every[order[k + (k >= rank)]] for k in (low, high))
        found = np.maximum(found, (below + (at - low) * (above - below)) / usual)
    return found


def _of_offsets(bundles: Bundles) -> Floats:
    """Return for each landmark (S,) the factor by which two points gain more because the boxes of a bundle share an offset.

    More rays do not average such an offset out. So the gain grows with the number of rays.
    """
    obs, ray, count = bundles.state.obs, bundles.ray, bundles.count // 2
    rays = np.bincount(bundles.group, minlength=2 * count).reshape(-1, 2)
    offset2 = (_OFF_CENTRE / obs.sigma[ray]) ** 2 * obs.size[ray].prod(axis=1)
    mean = np.bincount(bundles.group // 2, offset2, count) / rays.sum(axis=1)
    return np.asarray(mean * rays.prod(axis=1) / rays.sum(axis=1))


def _bearing_odds(gain: Floats, excess: Floats, landmarks: int) -> Floats:
    """Return the log odds (K, S) of two things over one by bearings.

    The excess comes from a limited number of landmarks, so the odds are from an F distribution.

    gain: (K, S) by how much K explanations of S landmarks as two things lower the cost of the rays. excess: (S,) from
    `excess_of`. landmarks: the number of gains from which the excess was computed.
    """
    number = landmarks - 1 + _ASSUMED
    tail = 0.5 * (number + _FREE) * np.log1p(np.maximum(gain, 0.0) / (excess * number))
    return np.asarray(tail + 0.5 * np.minimum(gain, 0.0) / excess)


def _as_one(bundles: Bundles) -> tuple[Floats, Floats]:
    """Judge the explanation that the two bundles of each landmark show one thing.

    Return its log likelihood (S,) without the bearings, and the cost (S,) of the bearings.
    """
    usual, landmark = bundles.usual, bundles.landmark[::2]
    start = bundles.state.landmarks.position[landmark]
    position, log_volume, _ = fit_points(bundles, bundles.group // 2, landmark, bundles.noise[::2], start)
    both = np.repeat(position, 2, axis=0)
    size, growth = bundles.size(both)
    each = growth + usual.far_odds(bundles.distance(both), bundles.landmark)
    larger = bundles.counted.reshape(-1, 2).argmax(axis=1)
    first, second = (size.reshape(-1, 2)[np.arange(len(larger)), which] for which in (larger, 1 - larger))
    sizes = _size_odds(first, usual.class_mean[landmark], usual.class_spread[landmark] ** 2 + usual.view**2)
    sizes += _size_odds(second, first, np.full(len(first), 2 * usual.view**2))
    rest = usual.log_density[landmark] + log_volume + each.reshape(-1, 2).sum(axis=1) + sizes
    return np.asarray(rest), bundles.bearing_cost(both).reshape(-1, 2).sum(axis=1)


def _alone(bundles: Bundles, free: FreeFit) -> tuple[Floats, Floats, Floats]:
    """Judge the explanation that each bundle shows a thing of its own.

    Return its log likelihood (G,) without the bearings, the cost (G,) of the bearings, and the likeliest position (G, 3) m
    of the thing. Many distances explain the bearings of a bundle. The sizes of its boxes, and the distances that are usual
    for the class, decide between them.
    """
    usual, landmark = bundles.usual, bundles.landmark
    mean, spread2 = usual.class_mean[landmark], usual.class_spread[landmark] ** 2 + usual.view**2
    tried = np.stack([*points_along(bundles), free.position])  # (K, G, 3)
    growth, size, cost, distance = np.empty((4, *tried.shape[:2]))
    for k, points in enumerate(tried):
        size[k], growth[k] = bundles.size(points)
        distance[k], cost[k] = bundles.distance(points), bundles.bearing_cost(points)
    fit = growth + usual.far_odds(distance.ravel(), np.tile(landmark, len(tried))).reshape(distance.shape)
    best = (fit - 0.5 * cost + _size_odds(size, mean, spread2)).argmax(axis=0), np.arange(bundles.count)
    # Where the bearings do not tell the distance, the size of the thing is not known either.
    loose = np.minimum(free.along / np.maximum(distance[best], MIN_DEPTH), 1.0)
    sizes = _size_odds(size[best], mean, spread2 + loose**2)
    return usual.log_density[landmark] + free.log_volume + fit[best] + sizes, cost[best], tried[best]


def _as_another(bundles: Bundles) -> tuple[Floats, Floats]:
    """Judge the explanation that each bundle shows another landmark.

    Return its log likelihood (G,) without the bearings, and the cost (G,) of the bearings. The likelihood is -inf if no
    other landmark fits.
    """
    state, usual = bundles.state, bundles.usual
    bundle = np.full(len(state.obs), -1)
    bundle[bundles.ray] = bundles.group
    edges = gated_edges(state.obs, state.landmarks, STRAY_RAY)
    # A landmark has at most one box in a frame.
    frames = int(state.obs.frame.max(initial=0)) + 1
    taken = np.isin(
        edges.landmark * frames + state.obs.frame[edges.ray], state.owner * frames + state.obs.frame[state.assigned]
    )
    useful = np.flatnonzero((bundle[edges.ray] >= 0) & ~taken)
    pairs, pair = np.unique(bundle[edges.ray[useful]] * state.count + edges.landmark[useful], return_inverse=True)
    saved = np.bincount(pair, STRAY_RAY - edges.deviation[useful], len(pairs))
    order = np.argsort(saved, kind="stable")
    to, most = np.full(bundles.count, -1), np.zeros(bundles.count)
    to[pairs[order] // state.count] = pairs[order] % state.count  # The last one stays. It saves most.
    most[pairs[order] // state.count] = saved[order]
    at = state.landmarks.position[to]
    size, growth = bundles.size(at)
    number = np.bincount(bundles.group, minlength=bundles.count)
    fit = growth + usual.far_odds(bundles.distance(at), bundles.landmark)
    alike = _size_odds(size, usual.size[to], np.full(bundles.count, 2 * usual.view**2))
    return np.where(to >= 0, fit + alike, -np.inf), number * STRAY_RAY - most


def _size_odds(size: Floats, mean: Floats, variance_: Floats) -> Floats:
    """Return the log likelihood (N,) of ln sizes (N,) with a mean and a variance (N,). It is 0 where a size or a mean is not
    known. It allows for views that show only a part of a thing."""
    normal = np.exp(-0.5 * (size - mean) ** 2 / variance_) / np.sqrt(2 * np.pi * variance_)
    return np.nan_to_num(np.log((1 - _HIDDEN) * normal + _HIDDEN / _HIDDEN_WIDTH))
