"""A-contrario consensus over ray pairs (AC-RANSAC): which rays of an object agree, for many objects at once, in torch.

No fixed threshold fits, because the box of a large object wanders by many times the pixel noise. So the consensus is the
share of rays whose agreement is the least likely by chance (Moisan & Stival, IJCV 57, 2004; Moisan, Moulon & Monasse, IPOL
2, 2012).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from objslam.triangulation.point_to_lines import least_squares, minimise_distances, object_sum

_VIEW_CAP = 1 - math.cos(math.radians(45))  # The view over which wrong boxes are uniform, a cone with 45 degrees half angle.
_NOISE_SIGMAS = 3.0  # The standard deviations within which a closer agreement scores no better.
_MOST_NOISE = 0.25  # The largest share of the view that noise may take; larger lets very noisy rays agree with any point.
_PAIRS_AT_ONCE = 1 << 19  # The most pairs of a ray and a hypothesis computed together; larger needs more memory.
_MAX_ROUNDS = 20  # The most alternations of Eq. 1 and selection, which end earlier once the agreement stops growing.


@dataclass(frozen=True)
class Bundle:
    """Rays of many objects, sorted by object.

    origin: (R, 3) m, in coordinates of their object. direction: (R, 3) unit. sigma: (R,) rad. position_sigma: m, noise of
    the origins. index: (R,) object of each ray. number: (N,) rays of each object.
    """

    origin: Tensor
    direction: Tensor
    sigma: Tensor
    position_sigma: float
    index: Tensor
    number: Tensor

    def chunks(self, objects: Tensor, hypotheses: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Split objects (indices) into chunks of similar size: objects (B,), their rays (B, n), and which rays are real."""
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
    """Solution of Eq. 1. point: (N, 3). determined: (N,) whether the rays fix it. gradient: (N,) norm. iterations."""

    point: Tensor
    determined: Tensor
    gradient: Tensor
    iterations: int


def solve_points(bundle: Bundle, use: Tensor) -> PointSolution:
    """Solve Eq. 1 on the rays in use (R,), from the least-squares points.

    Objects that their rays do not fix keep the point of `least_squares` and get a NaN gradient.
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
    """Solve Eq. 1 on the rays that agree, and return the solution, inlier (R,) and log NFA (N,).

    The candidates are Eq. 1 on all rays, ray pairs, and a point far ahead, on which nearly parallel rays agree. Eq. 1 and
    the selection then alternate from the best candidate while the agreement grows. An object without two agreeing rays keeps
    all its rays. hypotheses and jitter are as in `best_pair`.
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
    """Return which objects (N,) have all rays within the noise of their point, so that no candidate can be better."""
    to_point = points[bundle.index] - bundle.origin
    distance = to_point.norm(dim=1).clamp(min=1e-12)
    cos = (to_point * bundle.direction).sum(1) / distance
    noise2 = bundle.sigma.square() + (bundle.position_sigma / distance).square()
    outside = 1 - cos > 0.5 * _NOISE_SIGMAS**2 * noise2
    return object_sum(outside.to(cos.dtype), bundle.index, len(points)) == 0


def _far_ahead(bundle: Bundle) -> Tensor:
    """Return points (N, 3) on each object's mean direction, so far that all its rays see them in one direction."""
    count = len(bundle.number)
    reach = torch.zeros_like(bundle.number, dtype=bundle.origin.dtype)
    reach = reach.scatter_reduce(0, bundle.index, bundle.origin.norm(dim=1), "amax").clamp(min=1.0)
    heading = object_sum(bundle.direction, bundle.index, count)
    return heading / heading.norm(dim=1, keepdim=True).clamp(min=1e-12) * 1e6 * reach[:, None]


def consensus_about(bundle: Bundle, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the consensus about one point (N, 3) per object: inlier (R,), and log NFA (N,), below 0 if not by chance."""
    inlier = torch.zeros(len(bundle.origin), dtype=torch.bool, device=points.device)
    log_nfa = torch.full_like(points[:, 0], torch.inf)
    for objects, rays, real in bundle.chunks(torch.nonzero(bundle.number)[:, 0], 1):
        chance = _chance(bundle, rays, real, points[objects, None])
        log_nfa[objects, None], limit = _least_chance(chance, bundle.number[objects])
        inlier[rays[real]] = ((chance[:, 0] <= limit) & (chance[:, 0] < 1))[real]
    return inlier, log_nfa


def best_pair(bundle: Bundle, objects: Tensor, hypotheses: int, jitter: Tensor) -> Tensor:
    """Return the points (B, 3) of ray pairs with which the other rays agree most, NaN without a pair.

    objects: (B,) indices. hypotheses: the most pairs tried per object, spread evenly over all its pairs. jitter:
    (hypotheses,) in [0, 1), the place of each pair in its part. An object's result depends on its own rays alone.
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
    """Return pairs first < second (B, H) of each object's number (B,) of rays, and whether each pair exists."""
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
    """Return midpoints (B, H, 3) of the closest approach of two rays (B, H), and whether they exist: not if parallel.

    A midpoint may lie behind a ray, which then does not agree with it. `closest_approach` does this in numpy.
    """
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
    """Return the probability (B, H, n) that a wrong box is as close to points (B, H, 3) as each ray, 1 if it points away."""
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
    """Return the lowest log NFA (B, H) over all shares of rays with chances (B, H, n), and the largest chance in that share.

    NFA(k) = (n - 2) C(n, k) C(k, 2) p_k^(k - 3/2), where p_k is the k-th lowest chance. The k rays are 2 k numbers, and 3 of
    them determine the point. Each p counts for 2 numbers.
    """
    chance = chance.sort(dim=-1).values
    n = number.to(chance.dtype)[:, None]
    k = torch.arange(1, chance.shape[-1] + 1, device=chance.device, dtype=chance.dtype)
    count = torch.lgamma(n + 1) - torch.lgamma((k - 1).clamp(min=1)) - torch.lgamma((n - k + 1).clamp(min=1)) - math.log(2)
    count = torch.where((k >= 2) & (k <= n), count + (n - 2).clamp(min=1).log(), torch.inf)
    log_nfa, share = (count[:, None] + (k - 1.5) * chance.log()).min(dim=-1)
    return log_nfa, chance.gather(-1, share[..., None])[..., 0]
