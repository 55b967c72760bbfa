"""Find which rays of an object agree, for many objects at once, by a-contrario consensus (AC-RANSAC).

No fixed threshold fits all objects, because the box of a large object wanders by many times the pixel noise. So the
consensus is the subset of rays whose agreement is the least likely by chance (Moisan & Stival, IJCV 57, 2004; Moisan, Moulon
& Monasse, IPOL 2, 2012). The number of false alarms (NFA) is the expected number of subsets that agree equally well by
chance.
"""

import math
from types import ModuleType

from objslam.core.array_module import (
    Tensor,
    as_single,
    as_type,
    backend_of,
    group_sum,
    indices_of,
    length,
    sorted_last,
    take_along,
)
from objslam.triangulation.bundle import Bundle
from objslam.triangulation.point_to_lines import PointSolution, minimise_distances

_VIEW_CAP = 1 - math.cos(math.radians(45))
"""The directions of wrong boxes are assumed to be evenly distributed in this solid angle, in units of 2 pi sr. It is a cone
with a half angle of 45 degrees. With a larger angle, agreement counts as chance more rarely."""
_NOISE_SIGMAS = 3.0  # All deviations of a ray below this number of standard deviations score the same.
_MOST_NOISE = 0.25  # The largest share of the view that noise may cover. With more, noisy rays agree with any point.
_PAIRS_AT_ONCE = {"numpy": 1 << 17, "cpu": 1 << 19, "cuda": 1 << 25}
"""The most pairs of a ray and a hypothesis that are computed together, for each backend. A pair needs 50 bytes of memory.
Fewer pairs need more calls. In numpy, a consensus with 2^19 pairs took 1.6 times as long as with 2^16 or 2^17, because the
system allocates new memory pages for each array of this size. On an H100, 256,000,000 pairs took 1067 ms with 2^19, 77 ms
with 2^23, 64 ms with 2^25, and 62 ms with 2^29."""
_MAX_ROUNDS = 20  # The most rounds of Eq. 1 and selection. They end early if no selection changes. More are slower.


def fit_consensus(
    bundle: Bundle, hypotheses: int, jitter: Tensor, judged: Tensor | None = None
) -> tuple[PointSolution, Tensor, Tensor]:
    """Solve Eq. 1 for each object on its agreeing rays. Return the solutions, the agreeing rays (R,) and the log NFA (N,).

    Each object has three candidate points: the solution of Eq. 1 on all its rays, the best midpoint of two rays, and a point
    far ahead, with which nearly parallel rays agree. The midpoint is left out if an object has 2 rays, or if all its rays
    agree with the first point within noise. The search starts at the best candidate. It selects the rays that agree with the
    point, and solves Eq. 1 on them. It repeats both steps while the agreement grows. An object without two agreeing rays
    keeps all its rays.

    judged: (N,) the objects whose rays certainly do not meet by chance. Such an object keeps all its rays if they all agree
    within noise.
    hypotheses, jitter: as in `best_pair`.
    """
    xp = bundle.xp
    used = xp.ones_like(bundle.index, dtype=xp.bool)
    result = minimise_distances(bundle)
    fitting = _within_noise(bundle, result.point)
    searched = indices_of((bundle.number > 2) & ~fitting)
    candidates = [result.point, _far_ahead(bundle)]
    if len(searched):
        pair_point = xp.asarray(result.point, copy=True)
        pair_point[searched] = best_pair(bundle, searched, hypotheses, jitter)
        candidates.insert(1, pair_point)
    inlier, log_nfa = consensus_about(bundle, xp.stack(candidates, axis=1), bundle.with_rays())
    alone = group_sum(as_type(inlier, log_nfa), bundle.index, len(log_nfa)) < 2
    whole = alone if judged is None else alone | (fitting & judged)  # A part of few noisy rays may fit better by chance.
    inlier |= whole[bundle.index]
    for _ in range(_MAX_ROUNDS):
        changed = group_sum(as_type(inlier != used, log_nfa), bundle.index, len(log_nfa)) > 0
        if not bool(changed.any()):
            break
        again = minimise_distances(bundle.select(inlier & changed[bundle.index]))
        result = PointSolution(
            xp.where(changed[:, None], again.point, result.point),
            xp.where(changed, again.determined, result.determined),
            xp.where(changed, again.gradient, result.gradient),
            result.iterations + again.iterations,
        )
        used = inlier
        agreeing, nfa = consensus_about(bundle, result.point[:, None], indices_of(changed))
        better = nfa < log_nfa
        inlier, log_nfa = xp.where(better[bundle.index], agreeing, inlier), xp.where(better, nfa, log_nfa)
    return result, used, log_nfa


def _within_noise(bundle: Bundle, points: Tensor) -> Tensor:
    """Return a mask (N,) of the objects whose rays all agree with their point within noise.

    No other point can score better for such an object. points: (N, 3).
    """
    to_point = points[bundle.index] - bundle.origin
    distance = length(to_point).clip(min=1e-12)
    cos = (to_point * bundle.direction).sum(axis=1) / distance
    noise2 = bundle.sigma**2 + (bundle.position_sigma / distance) ** 2
    outside = 1 - cos > 0.5 * _NOISE_SIGMAS**2 * noise2
    return group_sum(as_type(outside, cos), bundle.index, len(points)) == 0


def _far_ahead(bundle: Bundle) -> Tensor:
    """Return a point (N, 3) along the mean ray direction of each object, so far that all rays see it in one direction."""
    count = len(bundle.number)
    reach = length(group_sum(bundle.origin**2, bundle.index, count)).clip(min=1.0)
    heading = group_sum(bundle.direction, bundle.index, count)
    return heading / length(heading)[:, None].clip(min=1e-12) * 1e6 * reach[:, None]


def consensus_about(bundle: Bundle, points: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
    """Return which rays (R,) agree with the best of the points (N, H, 3) of their object, and the log NFA (N,) of this
    agreement.

    The best point is the first one with the lowest log NFA. A log NFA below 0 means that the agreement is not by chance.
    objects: (B,) the indices of the objects that are judged. Other objects have no agreeing rays and an infinite log NFA.
    """
    xp = bundle.xp
    inlier = xp.zeros_like(bundle.index, dtype=xp.bool)
    log_nfa = xp.full_like(points[:, 0, 0], xp.inf)
    for chunk, rays, real in bundle.blocks(objects, _PAIRS_AT_ONCE[backend_of(points)] // points.shape[1]):
        chance = _chance(bundle, rays, real, points[chunk])
        nfa, limit = _least_chance(chance, bundle.number[chunk], xp)
        nfa = xp.where(xp.isnan(nfa), xp.inf, nfa)  # A candidate that does not exist has the point NaN.
        row, best = xp.arange(len(nfa), device=nfa.device), nfa.argmin(axis=1)
        log_nfa[chunk], chance = nfa[row, best], chance[row, best]
        inlier[rays[real]] = ((chance <= limit[row, best, None]) & (chance < 1))[real]
    return inlier, log_nfa


def best_pair(bundle: Bundle, objects: Tensor, hypotheses: int, jitter: Tensor) -> Tensor:
    """Return for each object the midpoint (B, 3) of two of its rays with which its rays agree most. NaN if no midpoint
    exists.

    objects: (B,) indices. hypotheses: the most pairs tried per object. If an object has more pairs, their list is split into
    `hypotheses` equal parts, and one pair of each part is tried. jitter: (hypotheses,) in [0, 1), the relative position of
    the tried pair in each part. The result of an object depends on its own rays alone.
    """
    xp = bundle.xp
    points = xp.full((len(bundle.number), 3), xp.nan, dtype=bundle.origin.dtype, device=bundle.origin.device)
    log_nfa = xp.full_like(points[:, 0], xp.inf)
    most = _PAIRS_AT_ONCE[backend_of(points)]
    for chunk, rays, real in bundle.blocks(objects, most // hypotheses):
        step = max(1, most // max(1, math.prod(rays.shape)))
        for begin in range(0, hypotheses, step):
            which = xp.arange(begin, min(begin + step, hypotheses), device=rays.device)
            first, second, exists = _pairs(bundle.number[chunk], which, hypotheses, jitter[which], xp)
            candidates, valid = _midpoints(bundle, take_along(rays, first, 1), take_along(rays, second, 1))
            chance = as_single(_chance(bundle, rays, real, candidates))  # Single precision is enough to rank, and faster.
            nfa = as_type(_least_chance(chance, bundle.number[chunk], xp)[0], points)
            nfa = xp.where(valid & exists, nfa, xp.inf)
            row, best = xp.arange(len(nfa), device=nfa.device), nfa.argmin(axis=1)
            lowest = nfa[row, best]
            better = lowest < log_nfa[chunk]
            winner = candidates[row, best]
            points[chunk] = xp.where(better[:, None], winner, points[chunk])
            log_nfa[chunk] = xp.minimum(lowest, log_nfa[chunk])
    return points[objects]


def _pairs(number: Tensor, which: Tensor, hypotheses: int, jitter: Tensor, xp: ModuleType) -> tuple[Tensor, Tensor, Tensor]:
    """Return the first and the second ray (B, H) of each pair, as indices among the object's rays, and which pairs exist.

    The first index is below the second. number: (B,) the number of rays of each object. which, jitter: (H,) the indices and
    the jitter of the hypotheses.
    """
    n = as_type(number[:, None], jitter)
    pairs = n * (n - 1) / 2
    rank = xp.where(pairs <= hypotheses, which, xp.floor((which + jitter) * (pairs / hypotheses)))
    exists = rank < pairs
    rank = xp.where(exists, rank, 0.0)
    first = xp.floor(((2 * n - 1) - xp.sqrt(((2 * n - 1) ** 2 - 8 * rank).clip(min=0))) / 2)
    first = first - as_type(first * (2 * n - first - 1) / 2 > rank, n)  # The root may be rounded up.
    first = first + as_type((first + 1) * (2 * n - first - 2) / 2 <= rank, n)  # The root may be rounded down.
    second = rank - first * (2 * n - first - 1) / 2 + first + 1
    last = (number[:, None] - 1).clip(min=0)
    return xp.minimum(as_type(first, last), last), xp.minimum(as_type(second, last), last), exists


def _midpoints(bundle: Bundle, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the midpoints (B, H, 3) of the closest approach of two rays (B, H), and which midpoints exist (B, H).

    Parallel rays have no midpoint. A midpoint may lie behind a ray, and then this ray does not agree with the midpoint.
    `closest_approach` does the same in numpy.
    """
    xp = bundle.xp
    n1, n2 = bundle.direction[first], bundle.direction[second]
    between = bundle.origin[second] - bundle.origin[first]
    cos = (n1 * n2).sum(-1)
    a, b = (between * n1).sum(-1), (between * n2).sum(-1)
    sin2 = (xp.linalg.cross(n1, n2) ** 2).sum(axis=-1)
    valid = sin2 > 1e-12
    sin2 = xp.where(valid, sin2, 1.0)
    along1, along2 = (a - cos * b) / sin2, (cos * a - b) / sin2
    one = bundle.origin[first] + along1[..., None] * n1
    two = bundle.origin[second] + along2[..., None] * n2
    return 0.5 * (one + two), valid


def _chance(bundle: Bundle, rays: Tensor, real: Tensor, points: Tensor) -> Tensor:
    """Return the probabilities (B, H, n) that the ray of a wrong box passes a point (B, H, 3) as closely as each ray does.

    The probability is 1 for a ray that is not `real`. It is also 1 for a ray more than 45 degrees away from the point.
    """
    xp = bundle.xp
    origin, direction, sigma = bundle.origin[rays], bundle.direction[rays], bundle.sigma[rays]
    along = points @ direction.mT - (origin * direction).sum(-1)[:, None]
    distance2 = (points**2).sum(-1)[..., None] - 2 * points @ origin.mT + (origin**2).sum(-1)[:, None]
    distance2 = distance2.clip(min=1e-12)
    noise2 = sigma[:, None] ** 2
    if bundle.position_sigma > 0:
        noise2 = noise2 + bundle.position_sigma**2 / distance2
    floor = (0.5 * _NOISE_SIGMAS**2 / _VIEW_CAP * noise2).clip(max=_MOST_NOISE)
    chance = xp.maximum((1 - along / xp.sqrt(distance2)) / _VIEW_CAP, floor).clip(max=1)
    return xp.where(real[:, None], chance, 1.0)


def _least_chance(chance: Tensor, number: Tensor, xp: ModuleType) -> tuple[Tensor, Tensor]:
    """Return the lowest log NFA (B, H) over all numbers k of agreeing rays, and the k-th lowest chance (B, H) for this k.

    The k agreeing rays are those with the lowest chances. chance: (B, H, n) as `_chance` returns it. number: (B,) the number
    of rays of each object.

    NFA(k) = (n - 2) C(n, k) C(k, 2) p_k^(k - 3/2), where p_k is the k-th lowest chance. The k rays measure 2 k coordinates,
    and 3 of them determine the point. Each p counts for 2 coordinates.
    """
    chance = sorted_last(chance)
    most = chance.shape[-1]
    k = xp.arange(1, most + 1, device=chance.device)
    n = number[:, None]
    log = xp.log(xp.arange(most + 1, dtype=xp.float64, device=chance.device).clip(min=1))
    factorial = xp.cumsum(log, 0)  # The logarithm of k! at k.
    count = factorial[n] - factorial[(k - 2).clip(min=0)] - factorial[(n - k).clip(min=0)] - math.log(2)
    count = xp.where((k >= 2) & (k <= n), count + log[(n - 2).clip(min=1)], xp.inf)
    log_nfa = as_type(count, chance)[:, None] + as_type(k - 1.5, chance) * xp.log(chance)
    share = log_nfa.argmin(axis=-1)[..., None]
    return take_along(log_nfa, share, -1)[..., 0], take_along(chance, share, -1)[..., 0]
