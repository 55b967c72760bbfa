"""Find which rays of an object agree, for many objects at once, in torch, by a-contrario consensus (AC-RANSAC).

No fixed threshold fits all objects, because the box of a large object wanders by many times the pixel noise. So the
consensus is the subset of rays whose agreement is the least likely by chance (Moisan & Stival, IJCV 57, 2004; Moisan, Moulon
& Monasse, IPOL 2, 2012). Its measure is the number of false alarms (NFA): how many subsets agree as well by chance.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from objslam.triangulation.point_to_lines import least_squares, minimise_distances, object_sum

_VIEW_CAP = 1 - math.cos(math.radians(45))
"""The view in which wrong boxes are uniformly distributed: a cone with 45 degrees half angle. Unit: 2 pi sr."""
_NOISE_SIGMAS = 3.0  # The standard deviations of noise below which a smaller deviation of a ray scores no better.
_MOST_NOISE = 0.25  # The largest share of the view for noise. A larger one lets very noisy rays agree with any point.
_PAIRS_AT_ONCE = 1 << 19  # The most pairs of a ray and a hypothesis computed together. A larger value needs more memory.
_MAX_ROUNDS = 20  # The most alternations of Eq. 1 and selection, which end earlier once the agreement stops growing.


@dataclass(frozen=True)
class Bundle:
    """Rays of many objects, sorted by object. origin: (R, 3) m, in coordinates of the ray's object. direction: (R, 3) unit.
    sigma: (R,) rad, noise along each perpendicular axis. position_sigma: m, noise of the origins. index: (R,) object of each
    ray. number: (N,) number of rays of each object."""

    origin: Tensor
    direction: Tensor
    sigma: Tensor
    position_sigma: float
    index: Tensor
    number: Tensor

    def chunks(self, objects: Tensor, hypotheses: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Split objects, given by their indices, into chunks of objects with similar numbers of rays. A chunk holds the
        objects (B,), the indices of their rays (B, n), and which of these are real. The others only fill the rows of objects
        with fewer rays. hypotheses: the number of points to score per object. It limits the chunks."""
        first = torch.cumsum(self.number, 0) - self.number
        objects = objects[torch.argsort(self.number[objects], stable=True)]
        while len(objects):
            size = self.number[objects]
            fits = torch.arange(1, len(objects) + 1, device=size.device) * size * hypotheses <= _PAIRS_AT_ONCE
            end = max(1, int(fits.sum()))  # The sizes increase, so the fitting objects come first.
            slot = torch.arange(int(size[end - 1]), device=size.device)
            real = slot < size[:end, None]
            yield objects[:end], first[objects[:end], None] + torch.where(real, slot, 0), real
            objects = objects[end:]


@dataclass(frozen=True)
class PointSolution:
    """Solutions of Eq. 1. point: (N, 3) m. determined: (N,) whether the rays fix the point. gradient: (N,) norm of the
    gradient, NaN if they do not. iterations: the number of solver iterations."""

    point: Tensor
    determined: Tensor
    gradient: Tensor
    iterations: int


def solve_points(bundle: Bundle, use: Tensor) -> PointSolution:
    """Solve Eq. 1 on the rays in `use` (R,), starting at the least-squares points.

    An object whose rays fix no point keeps the point of `least_squares` and gets a NaN gradient.
    """
    origin, direction, index = bundle.origin[use], bundle.direction[use], bundle.index[use]
    point, determined = least_squares(origin, direction, index, len(bundle.number))
    gradient = torch.full_like(point[:, 0], torch.nan)
    rays = determined[index]
    number = (torch.cumsum(determined, 0) - 1)[index[rays]]
    solved = minimise_distances(origin[rays], direction[rays], number, point[determined])
    point[determined], iterations, gradient[determined] = solved
    return PointSolution(point, determined, gradient, iterations)


def fit_consensus(bundle: Bundle, hypotheses: int, jitter: Tensor) -> tuple[PointSolution, Tensor, Tensor]:
    """Solve Eq. 1 for each object on its agreeing rays. Return the solutions, the agreeing rays (R,) and the log NFA (N,).

    Each object has three candidate points: the solution of Eq. 1 on all its rays, the best midpoint of two rays, and a point
    far ahead, on which nearly parallel rays agree. From the best candidate on, two steps alternate while the agreement
    grows: select the rays that agree with the point, and solve Eq. 1 on them. An object without two agreeing rays keeps all
    its rays. `hypotheses` and `jitter` are as in `best_pair`.
    """
    used = torch.ones(len(bundle.origin), dtype=torch.bool, device=bundle.origin.device)
    result = solve_points(bundle, used)
    inlier, log_nfa = consensus_about(bundle, result.point)

    def improve(candidate: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
        agreeing, nfa = consensus_about(bundle, candidate)
        better = objects & (nfa < log_nfa)
        return torch.where(better[bundle.index], agreeing, inlier), torch.where(better, nfa, log_nfa)

    searched = torch.nonzero((bundle.number > 2) & ~_within_noise(bundle, result.point))[:, 0]
    pair_point = result.point.clone()
    pair_point[searched] = best_pair(bundle, searched, hypotheses, jitter)
    for candidate in (pair_point, _far_ahead(bundle)):
        inlier, log_nfa = improve(candidate, torch.ones_like(result.determined))
    alone = object_sum(inlier.to(log_nfa.dtype), bundle.index, len(log_nfa)) < 2
    inlier |= alone[bundle.index]
    for _ in range(_MAX_ROUNDS):
        changed = object_sum((inlier != used).to(log_nfa.dtype), bundle.index, len(log_nfa)) > 0
        if not changed.any():
            break
        again = solve_points(bundle, inlier & changed[bundle.index])
        result = PointSolution(
            torch.where(changed[:, None], again.point, result.point),
            torch.where(changed, again.determined, result.determined),
            torch.where(changed, again.gradient, result.gradient),
            result.iterations + again.iterations,
        )
        used = inlier
        inlier, log_nfa = improve(result.point, changed)
    return result, used, log_nfa


def _within_noise(bundle: Bundle, points: Tensor) -> Tensor:
    """Return for which objects (N,) all rays agree with the object's point within noise. No other point can score better."""
    to_point = points[bundle.index] - bundle.origin
    distance = to_point.norm(dim=1).clamp(min=1e-12)
    cos = (to_point * bundle.direction).sum(1) / distance
    noise2 = bundle.sigma.square() + (bundle.position_sigma / distance).square()
    outside = 1 - cos > 0.5 * _NOISE_SIGMAS**2 * noise2
    return object_sum(outside.to(cos.dtype), bundle.index, len(points)) == 0


def _far_ahead(bundle: Bundle) -> Tensor:
    """Return a point (N, 3) along the mean ray direction of each object, so far that all rays see it in one direction."""
    count = len(bundle.number)
    reach = torch.zeros_like(bundle.number, dtype=bundle.origin.dtype)
    reach = reach.scatter_reduce(0, bundle.index, bundle.origin.norm(dim=1), "amax").clamp(min=1.0)
    heading = object_sum(bundle.direction, bundle.index, count)
    return heading / heading.norm(dim=1, keepdim=True).clamp(min=1e-12) * 1e6 * reach[:, None]


def consensus_about(bundle: Bundle, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return which rays (R,) agree with the point (N, 3) of their object, and the log NFA (N,) of this agreement. A log NFA
    below 0 means that the agreement is not by chance."""
    inlier = torch.zeros(len(bundle.origin), dtype=torch.bool, device=points.device)
    log_nfa = torch.full_like(points[:, 0], torch.inf)
    for objects, rays, real in bundle.chunks(torch.nonzero(bundle.number)[:, 0], 1):
        chance = _chance(bundle, rays, real, points[objects, None])
        log_nfa[objects, None], limit = _least_chance(chance, bundle.number[objects])
        inlier[rays[real]] = ((chance[:, 0] <= limit) & (chance[:, 0] < 1))[real]
    return inlier, log_nfa


def best_pair(bundle: Bundle, objects: Tensor, hypotheses: int, jitter: Tensor) -> Tensor:
    """Return for each object the midpoint (B, 3) of two rays with which its rays agree most. NaN if no midpoint exists.

    objects: (B,) indices. hypotheses: the most pairs tried per object. If an object has more pairs, their list is split into
    that many equal parts, and one pair of each part is tried. jitter: (hypotheses,) in [0, 1), the relative position of this
    pair in its part. The result of an object depends on its own rays alone.
    """
    points = bundle.origin.new_full((len(bundle.number), 3), torch.nan)
    log_nfa = torch.full_like(points[:, 0], torch.inf)
    for chunk, rays, real in bundle.chunks(objects, hypotheses):
        step = max(1, _PAIRS_AT_ONCE // max(1, rays.numel()))
        for begin in range(0, hypotheses, step):
            which = torch.arange(begin, min(begin + step, hypotheses), device=rays.device)
            first, second, exists = _pairs(bundle.number[chunk], which, hypotheses, jitter[which])
            candidates, valid = _midpoints(bundle, rays.gather(1, first), rays.gather(1, second))
            chance = _chance(bundle, rays, real, candidates).float()  # Single precision is enough for ranking, and faster.
            nfa = _least_chance(chance, bundle.number[chunk])[0].double()
            nfa = torch.where(valid & exists, nfa, torch.inf)
            best = nfa.argmin(dim=1, keepdim=True)
            lowest = nfa.gather(1, best)[:, 0]
            better = lowest < log_nfa[chunk]
            winner = candidates.gather(1, best[:, :, None].expand(-1, 1, 3))[:, 0]
            points[chunk] = torch.where(better[:, None], winner, points[chunk])
            log_nfa[chunk] = torch.minimum(lowest, log_nfa[chunk])
    return points[objects]


def _pairs(number: Tensor, which: Tensor, hypotheses: int, jitter: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pairs (B, H) of rays `first` < `second` of objects with `number` (B,) rays, and whether each pair exists.
    which: (H,) indices of the hypotheses, with their jitter (H,)."""
    n = number[:, None].to(jitter.dtype)
    pairs = n * (n - 1) / 2
    rank = torch.where(pairs <= hypotheses, which, torch.floor((which + jitter) * (pairs / hypotheses)))
    exists = rank < pairs
    rank = torch.where(exists, rank, 0.0)
    first = torch.floor(((2 * n - 1) - ((2 * n - 1) ** 2 - 8 * rank).clamp(min=0).sqrt()) / 2)
    first = first - (first * (2 * n - first - 1) / 2 > rank).to(n.dtype)  # The root may be rounded up.
    first = first + ((first + 1) * (2 * n - first - 2) / 2 <= rank).to(n.dtype)  # The root may be rounded down.
    second = rank - first * (2 * n - first - 1) / 2 + first + 1
    last = (number[:, None] - 1).clamp(min=0)
    return torch.minimum(first.long(), last), torch.minimum(second.long(), last), exists


def _midpoints(bundle: Bundle, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the midpoints (B, H, 3) of the closest approach of two rays (B, H), and whether they exist. Parallel rays have
    no midpoint. A midpoint may lie behind a ray. The ray then does not agree with it. `closest_approach` does the same in
    numpy."""
    n1, n2 = bundle.direction[first], bundle.direction[second]
    between = bundle.origin[second] - bundle.origin[first]
    cos = (n1 * n2).sum(-1)
    a, b = (between * n1).sum(-1), (between * n2).sum(-1)
    sin2 = torch.linalg.cross(n1, n2, dim=-1).square().sum(-1)
    valid = sin2 > 1e-12
    sin2 = torch.where(valid, sin2, 1.0)
    along1, along2 = (a - cos * b) / sin2, (cos * a - b) / sin2
    one = bundle.origin[first] + along1[..., None] * n1
    two = bundle.origin[second] + along2[..., None] * n2
    return 0.5 * (one + two), valid


def _chance(bundle: Bundle, rays: Tensor, real: Tensor, points: Tensor) -> Tensor:
    """Return the probability (B, H, n) that the ray of a wrong box is as close to the points (B, H, 3) as each ray is. It is
    1 for a ray that points away from the point, and for a ray that is not `real`."""
    origin, direction, sigma = bundle.origin[rays], bundle.direction[rays], bundle.sigma[rays]
    along = points @ direction.mT - (origin * direction).sum(-1)[:, None]
    distance2 = points.square().sum(-1)[..., None] - 2 * points @ origin.mT + origin.square().sum(-1)[:, None]
    distance2 = distance2.clamp(min=1e-12)
    noise2 = sigma.square()[:, None]
    if bundle.position_sigma > 0:
        noise2 = noise2 + bundle.position_sigma**2 / distance2
    floor = (0.5 * _NOISE_SIGMAS**2 / _VIEW_CAP * noise2).clamp(max=_MOST_NOISE)
    chance = torch.maximum((1 - along * distance2.rsqrt()) / _VIEW_CAP, floor).clamp(max=1)
    return torch.where(real[:, None], chance, 1.0)


def _least_chance(chance: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest log NFA (B, H) over all k, and the k-th lowest chance for this k. The k rays with the lowest chances
    are the ones that agree. chance: (B, H, n) of each ray.

    NFA(k) = (n - 2) C(n, k) C(k, 2) p_k^(k - 3/2), where p_k is the k-th lowest chance. The k rays measure 2 k coordinates,
    and 3 of them determine the point. Each p counts for 2 coordinates.
    """
    chance = chance.sort(dim=-1).values
    n = number.to(chance.dtype)[:, None]
    k = torch.arange(1, chance.shape[-1] + 1, device=chance.device, dtype=chance.dtype)
    count = torch.lgamma(n + 1) - torch.lgamma((k - 1).clamp(min=1)) - torch.lgamma((n - k + 1).clamp(min=1)) - math.log(2)
    count = torch.where((k >= 2) & (k <= n), count + (n - 2).clamp(min=1).log(), torch.inf)
    log_nfa, share = (count[:, None] + (k - 1.5) * chance.log()).min(dim=-1)
    return log_nfa, chance.gather(-1, share[..., None])[..., 0]
