"""Tell one thing from two things whose rays cross. In tracking by bearings, such a crossing is a ghost.

Rays from a short stretch of the path, a bundle, hardly tell how far away their thing is. Two bundles in a plane always meet
somewhere. So two stretches that see two things give a landmark behind both, or between them, and all rays fit it. The
likelihood of all data of both bundles tells which explanation is right: of bearings, of the sizes of boxes, of how they
grow, and of distances, which are usual for the class or not. The unknown positions are integrated out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.crossings.bundles import second_bundle
from objslam.association.crossings.usual_views import UsualViews
from objslam.association.gating import gated_edges
from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH
from objslam.association.refinement import grouped_sums, refine, squared_offsets, variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import STRAY_RAY, grouped_median

_GAP = np.radians(2.0)
"""The least gap (rad) between the two bundles of a landmark. Closer bundles are one stretch of the path. A smaller gap tests
more landmarks."""
_HIDDEN, _HIDDEN_WIDTH = 0.1, 4.6
"""The assumed share of views that show only a part of a thing, and the width of the uniform distribution of their ln size: a
factor of 100. With a larger share, different sizes tell less."""
_COUNTED = 10
"""The most boxes of a bundle that count as independent measurements of its growth, as in `existence`. A larger number trusts
growing boxes more."""
_TIGHTNESS = 0.1
"""The standard deviation by which ln size may change over a bundle beside the distance: a detector's boxes are less tight
around small things. A larger value trusts growing boxes less."""
_ASSUMED = 3
"""The number of landmarks that are assumed to have the usual gain, beside those of the log. With a larger number, errors
that rays share make more landmarks two."""
_FREE = 3
"""The degrees of freedom of a second point."""
_USUAL_GAIN = 2.366
"""The median by which the cost of the rays of one thing falls if two points explain them: that of chi-squared with `_FREE`
degrees of freedom."""
_STEPS = 48
"""The number of distances that are tried for a bundle, evenly in ln distance. A larger number is more exact, and slower."""
_NEAREST, _FURTHEST = 0.03, 2.0
"""The least and the greatest tried distance of a bundle, in usual distances of its class."""


@dataclass(frozen=True)
class Crossings:
    """S landmarks whose rays come in two bundles.

    landmark: (S,). second: (R,) whether a ray is in the second bundle of its landmark. odds: (S,) log odds that the landmark
    is one thing. position: (S, 2, 3) m, where the two things are if it is two.
    """

    landmark: Ints
    second: Bools
    odds: Floats
    position: Floats


@dataclass(frozen=True)
class _Bundles:
    """G = 2 S bundles of S landmarks. The bundles of landmark i are 2 i and 2 i + 1.

    ray, group: (P,) the rays, and the bundle of each. landmark: (G,) of each bundle. noise: (G,) factor on the noise of its
    rays. counted: (G,) how many boxes count as independent.
    """

    usual: UsualViews
    ray: Ints
    group: Ints
    landmark: Ints
    noise: Floats
    counted: Ints

    @property
    def state(self) -> State:
        return self.usual.state

    @property
    def count(self) -> int:
        return len(self.landmark)

    def bearing_cost(self, position: Floats) -> Floats:
        """Return the sum (G,) of the squared deviations of the rays of each bundle from a point (G, 3) m."""
        off2, away = squared_offsets(self.state.obs, position[self.group], self.ray)
        squared = off2 / variance(self.state.obs, away, self.noise[self.group], self.ray)
        return np.asarray(np.bincount(self.group, np.minimum(squared, STRAY_RAY), self.count), dtype=float)

    def distance(self, position: Floats) -> Floats:
        """Return the median distance (G,) m of each bundle's cameras from a point (G, 3) m."""
        away = np.linalg.norm(position[self.group] - self.state.obs.origin[self.ray], axis=1)
        return grouped_median(away, self.group, self.count)

    def size(self, position: Floats) -> tuple[Floats, Floats]:
        """Return the median ln size (G,) of each bundle's boxes if they show a thing at a point (G, 3) m, NaN without sizes,
        and the log likelihood (G,) of how they grow, up to a constant.

        The likelihood is that of a normal distribution of unknown variance.
        """
        away = np.linalg.norm(position[self.group] - self.state.obs.origin[self.ray], axis=1)
        ln_size = self.usual.ln_size[self.ray] + np.log(np.maximum(away, MIN_DEPTH))
        told = np.isfinite(ln_size)
        group, ln_size = self.group[told], ln_size[told]
        number = np.maximum(np.bincount(group, minlength=self.count), 1)
        mean = np.bincount(group, ln_size, self.count) / number
        scatter2 = np.bincount(group, (ln_size - mean[group]) ** 2, self.count) / number + _TIGHTNESS**2
        growth = -0.5 * self.counted * np.log(scatter2)
        return grouped_median(ln_size, group, self.count), np.asarray(growth, dtype=float)


def find_crossings(state: State, sized: Bools) -> Crossings:
    """Compare one thing and two things as explanations of each landmark whose rays come in two bundles.

    Things of a class lie anywhere in the mapped space, as dense as its landmarks. The second thing of a landmark may also be
    another landmark that fits the bundle's rays. sized: (R,) whether the camera of each ray observes sizes.
    """
    second = np.zeros(len(state.obs), dtype=bool)
    second[state.assigned] = second_bundle(state.obs.direction[state.assigned], state.owner, state.count, _GAP)
    two = np.flatnonzero(np.bincount(state.owner, second[state.assigned], state.count))
    if not len(two):
        return Crossings(two, second, np.zeros(0), np.zeros((0, 2, 3)))
    ray = state.assigned[np.isin(state.owner, two)]
    group = 2 * np.searchsorted(two, state.matched[ray]) + second[ray]
    number, landmark = np.bincount(group, minlength=2 * len(two)), np.repeat(two, 2)
    # The noise of the class, because a landmark that is two has much noise of its own.
    noise = state.class_noise[state.label[landmark]]
    bundles = _Bundles(UsualViews.of(state, sized), ray, group, landmark, noise, np.minimum(number, _COUNTED))
    one, one_cost = _as_one(bundles)
    alone, alone_cost, position = _alone(bundles)
    other, other_cost = _as_another(bundles)
    (a, b), (c, d) = alone.reshape(-1, 2).T, other.reshape(-1, 2).T
    (p, q), (r, s) = alone_cost.reshape(-1, 2).T, other_cost.reshape(-1, 2).T
    better = _bearing_odds(one_cost - np.array([p + q, p + s, r + q]))
    better[0, _overlap(bundles, position)] = -np.inf
    return Crossings(two, second, one - (np.array([a + b, a + d, c + b]) + better).max(axis=0), position.reshape(-1, 2, 3))


def _overlap(bundles: _Bundles, position: Floats) -> Bools:
    """Return for each pair (S,) of bundles whether things of their size at points (G, 3) m would overlap.

    Two things do not. The rays to the middles of the boxes of a large thing, from two sides, do not meet in one point, and
    two points inside it explain them better.
    """
    apart = np.linalg.norm(position[::2] - position[1::2], axis=1)
    return np.asarray(apart < np.exp(bundles.size(position)[0]).reshape(-1, 2).mean(axis=1))


def without_smaller_bundles(state: State, sized: Bools) -> State:
    """Return the state without the rays of the smaller bundle of each landmark that is two things. sized: as in
    `find_crossings`."""
    found = find_crossings(state, sized)
    mine = np.flatnonzero(np.isin(state.matched, found.landmark[found.odds < 0]))
    second = np.bincount(state.owner, found.second[state.assigned], state.count)
    smaller = found.second[mine] == (2 * second <= state.ray_count)[state.matched[mine]]
    matched = state.matched.copy()
    matched[mine[smaller]] = -1
    return replace(state, matched=matched)


def _bearing_odds(gain: Floats) -> Floats:
    """Return the log odds (K, S) of two things over one by bearings.

    Rays share errors, as of poses and clocks. Then two points fit the rays of one thing better than noise explains. The
    median gain of the other landmarks tells how much better. It is as uncertain as their number says, so that the odds are
    those of an F distribution.

    gain: (K, S) by how much K explanations of S landmarks as two things lower the cost of the rays. The first explanation
    has two points of its own.
    """
    number = gain.shape[1] - 1 + _ASSUMED
    usual = [np.median(np.append(np.delete(gain[0], j), np.full(_ASSUMED, _USUAL_GAIN))) for j in range(gain.shape[1])]
    excess = np.maximum(1.0, np.array(usual) / _USUAL_GAIN)
    tail = 0.5 * (number + _FREE) * np.log1p(np.maximum(gain, 0.0) / (excess * number))
    return np.asarray(tail + 0.5 * np.minimum(gain, 0.0) / excess)


def _as_one(bundles: _Bundles) -> tuple[Floats, Floats]:
    """Return the log likelihood (S,) of each pair of bundles as one thing without that of its bearings, and their cost
    (S,)."""
    usual, landmark = bundles.usual, bundles.landmark[::2]
    position, log_volume, _ = _fit(bundles, bundles.group // 2, landmark, bundles.noise[::2])
    both = np.repeat(position, 2, axis=0)
    size, growth = bundles.size(both)
    each = growth + usual.far_odds(bundles.distance(both), bundles.landmark)
    larger = bundles.counted.reshape(-1, 2).argmax(axis=1)
    first, second = (size.reshape(-1, 2)[np.arange(len(larger)), which] for which in (larger, 1 - larger))
    sizes = _size_odds(first, usual.class_mean[landmark], usual.class_spread[landmark] ** 2 + usual.view**2)
    sizes += _size_odds(second, first, np.full(len(first), 2 * usual.view**2))
    rest = usual.log_density[landmark] + log_volume + each.reshape(-1, 2).sum(axis=1) + sizes
    return np.asarray(rest), bundles.bearing_cost(both).reshape(-1, 2).sum(axis=1)


def _alone(bundles: _Bundles) -> tuple[Floats, Floats, Floats]:
    """Return the log likelihood (G,) of each bundle as a thing of its own without that of its bearings, their cost (G,), and
    where it most likely is (G, 3) m.

    Many distances explain the bearings of a bundle. The sizes of its boxes, and distances that are usual for the class,
    decide between them.
    """
    usual, landmark = bundles.usual, bundles.landmark
    fitted, log_volume, along = _fit(bundles, bundles.group, landmark, bundles.noise)
    mean, spread2 = usual.class_mean[landmark], usual.class_spread[landmark] ** 2 + usual.view**2
    tried = np.stack([*_along(bundles), fitted])  # (K, G, 3)
    fit, size, cost = np.empty((3, *tried.shape[:2]))
    for k, points in enumerate(tried):
        size[k], growth = bundles.size(points)
        fit[k] = growth + usual.far_odds(bundles.distance(points), landmark)
        cost[k] = bundles.bearing_cost(points)
    best = (fit - 0.5 * cost + _size_odds(size, mean, spread2)).argmax(axis=0), np.arange(bundles.count)
    # Where the bearings do not tell the distance, the size of the thing is not known either.
    loose = np.minimum(along / np.maximum(bundles.distance(tried[best]), MIN_DEPTH), 1.0)
    sizes = _size_odds(size[best], mean, spread2 + loose**2)
    return usual.log_density[landmark] + log_volume + fit[best] + sizes, cost[best], tried[best]


def _as_another(bundles: _Bundles) -> tuple[Floats, Floats]:
    """Return the log likelihood (G,) of each bundle as rays of another landmark without that of its bearings, and their cost
    (G,). The likelihood is -inf if no other landmark fits."""
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
    to[pairs[order] // state.count] = pairs[order] % state.count  # The last one stays, which saves most.
    most[pairs[order] // state.count] = saved[order]
    at = state.landmarks.position[to]
    size, growth = bundles.size(at)
    number = np.bincount(bundles.group, minlength=bundles.count)
    fit = growth + usual.far_odds(bundles.distance(at), bundles.landmark)
    alike = _size_odds(size, usual.size[to], np.full(bundles.count, 2 * usual.view**2))
    return np.where(to >= 0, fit + alike, -np.inf), number * STRAY_RAY - most


def _fit(bundles: _Bundles, index: Ints, landmark: Ints, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Fit points to groups of rays.

    Returns the positions (N, 3) m, ln of the volume (N,) m^3 over which the likelihood integrates, and the standard
    deviation (N,) m along the direction that is known least. Without parallax, the usual distance of the class limits both.
    index: (P,) the group of each ray. landmark, noise: (N,) of each group.
    """
    state, ray, count = bundles.state, bundles.ray, len(landmark)
    position = refine(state.obs, ray, index, state.landmarks.position[landmark], noise)
    away = np.maximum(np.linalg.norm(position[index] - state.obs.origin[ray], axis=1), MIN_DEPTH)
    n = state.obs.direction[ray]
    across = (np.eye(3) - n[:, :, None] * n[:, None, :]) / variance(state.obs, away, noise[index], ray)[:, None, None]
    information = grouped_sums(across.reshape(-1, 9), index, count).reshape(-1, 3, 3)
    # A uniform distribution over the usual distance has its variance.
    information += (12 / bundles.usual.distance[landmark] ** 2)[:, None, None] * np.eye(3)
    eigenvalues = np.linalg.eigvalsh(information)
    log_volume = 1.5 * np.log(2 * np.pi) - 0.5 * np.log(eigenvalues).sum(axis=1)
    return position, log_volume, 1 / np.sqrt(eigenvalues[:, 0])


def _along(bundles: _Bundles) -> list[Floats]:
    """Return points (G, 3) m at several distances along the mean ray of each bundle, where its rays agree best.

    The distance counts from the foremost camera, so that the points lie in front of all cameras.
    """
    obs, ray, group, count = bundles.state.obs, bundles.ray, bundles.group, bundles.count
    mean = grouped_sums(obs.direction[ray], group, count)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    ahead = np.einsum("pi,pi->p", obs.origin[ray], mean[group])
    foremost = np.full(count, -np.inf)
    np.maximum.at(foremost, group, ahead)
    slope = np.maximum(np.einsum("pi,pi->p", obs.direction[ray], mean[group]), 0.1)
    points = []
    for share in np.geomspace(_NEAREST, _FURTHEST, _STEPS).tolist():
        reach = (foremost[group] - ahead + share * bundles.usual.distance[bundles.landmark][group]) / slope
        weight = 1 / variance(obs, reach, bundles.noise[group], ray)
        at = obs.origin[ray] + reach[:, None] * obs.direction[ray]
        points.append(grouped_sums(weight[:, None] * at, group, count) / np.bincount(group, weight, count)[:, None])
    return points


def _size_odds(size: Floats, mean: Floats, variance_: Floats) -> Floats:
    """Return the log likelihood (N,) of ln sizes (N,) with a mean and a variance (N,), 0 where one of them is not known.
    Some views show only a part of a thing."""
    normal = np.exp(-0.5 * (size - mean) ** 2 / variance_) / np.sqrt(2 * np.pi * variance_)
    return np.nan_to_num(np.log((1 - _HIDDEN) * normal + _HIDDEN / _HIDDEN_WIDTH))
