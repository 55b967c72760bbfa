"""Where objects could be: points that many rays of one label agree on, found from pairs of rays, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.core.arrays import Floats, Ints
from objslam.core.torch_threads import one_torch_thread

_PAIRS_AT_ONCE = 1 << 18  # The pairs of a ray and a point scored together, so that they fit into the processor's cache.
_DRAWS_EACH = 8  # The pairs of rays drawn for each hypothesis that is wanted: most pairs do not meet.
_REFINEMENTS = 2  # How often each hypothesis is moved to the least squares of its supporters; larger costs time.
_MIN_LEFT = (
    0.6  # The least share of its support that better ones leave a hypothesis; with less it waits for the next search.
)
_SINGLE_EXTENT = 30.0  # The greatest extent (m) of the origins for single precision; beyond it would lose millimetres.
_RANGE_LIMIT = 3.0  # The standard deviations from which a range is wrong.
_RANGE_SHARE = 0.6  # The share of a ray's support that a wrong range takes; larger trusts ranges more.
_LADDER = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0)  # The distances (m) tried along rays that have no parallax.


@dataclass(frozen=True)
class Search:
    """How to search: the number of hypotheses, the least support of a point, the gate (squared deviations), the least
    parallax (rad) of a pair, 0 to try distances along single rays too, and torch's device."""

    hypotheses: int
    support: float
    gate: float
    parallax: float
    device: str


def discover(obs: Observations, search: Search, rng: np.random.Generator) -> Floats:
    """Points (N, 3) m that rays of one label agree on, the best supported first; none lives on the rays of a better one.

    Each hypothesis is scored against all rays at once. Of each frame the best ray counts: 1 if it fits, 0 at the gate.
    """
    points = _propose(obs, search, rng)
    if len(points) == 0:
        return points
    with one_torch_thread():
        return _best(points, _Scorer(obs, search), search.support)


def _best(points: Floats, scorer: _Scorer, least: float) -> Floats:
    """The points that rays agree on, refined, the best first; each has at least `least` support that no better one took."""
    moved = scorer.load(points)
    for _ in range(_REFINEMENTS):
        moved = scorer.refine(moved, scorer.supports(moved))
    support = scorer.supports(moved)
    whole = scorer.per_frame(support)
    left, found = whole.clone(), []
    for _ in range(len(moved)):
        best = int(torch.where(left >= _MIN_LEFT * whole, left, 0.0).argmax())
        if float(left[best]) < max(least, _MIN_LEFT * float(whole[best])):
            break
        found.append(best)
        taken = support[best] > scorer.doubt
        left -= support[:, taken].sum(dim=1)
        support[:, taken] = 0.0
    return scorer.unload(moved[found])


def _propose(obs: Observations, search: Search, rng: np.random.Generator) -> Floats:
    """Points (H, 3): where two rays of different frames meet, and where measured ranges end."""
    first, second = _draw(obs, _DRAWS_EACH * search.hypotheses, rng)
    depth1, depth2, middle, apart2, sin2 = closest_approach(obs, first, second)
    limit = (obs.sigma[first] * depth1) ** 2 + (obs.sigma[second] * depth2) ** 2 + 2 * obs.position_sigma**2
    meet = (depth1 > MIN_DEPTH) & (depth2 > MIN_DEPTH) & (apart2 <= search.gate * limit)
    meet &= (obs.frame[first] != obs.frame[second]) & (sin2 >= max(np.sin(search.parallax), 1e-3) ** 2)
    points = [middle[meet][: search.hypotheses]]
    ranged = np.flatnonzero(np.isfinite(obs.range))
    if len(ranged):
        some = rng.permutation(ranged)[: search.hypotheses // 2]
        points.append(obs.origin[some] + obs.range[some, None] * obs.direction[some])
    if search.parallax == 0:
        some = rng.permutation(len(obs))[: search.hypotheses // len(_LADDER)]
        ladder = np.array(_LADDER)[:, None, None] * obs.direction[some]
        points.append((obs.origin[some] + ladder).reshape(-1, 3))
    return np.concatenate(points)


def _draw(obs: Observations, count: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Pairs of rays: the second comes from the first one's track half of the time, if it has one, else from any frame.

    The number of rays in between is spread evenly over its logarithm, because near frames more often show the same object.
    """
    n = len(obs)
    first = rng.integers(n, size=count)
    reach = np.exp(rng.uniform(0.0, np.log(max(n, 2)), count)).astype(np.int64)
    second = first + reach * rng.choice([-1, 1], count)
    second = np.where((second < 0) | (second >= n), first - (second - first), second)
    order = np.argsort(obs.track, kind="stable")
    sorted_tracks = obs.track[order]
    begin, end = (np.searchsorted(sorted_tracks, obs.track[first], side=side) for side in ("left", "right"))
    mate = order[begin + (rng.random(count) * (end - begin)).astype(np.int64)]
    second = np.where((obs.track[first] >= 0) & (rng.random(count) < 0.5), mate, second)
    inside = (second >= 0) & (second < n)
    return first[inside], second[inside]


class _Scorer:
    """Rays of one label, laid out so that the best ray of each frame is a running maximum over slices.

    Slice k holds the k-th ray of every frame that has more than k rays, the frames with most rays first.
    """

    def __init__(self, obs: Observations, search: Search) -> None:
        _, frame, number = np.unique(obs.frame, return_inverse=True, return_counts=True)
        rank = np.arange(len(obs)) - (np.cumsum(number) - number)[frame]  # the rays of a frame stand together
        self.slices = np.bincount(rank).tolist()
        obs = obs.take(np.lexsort((frame, -number[frame], rank)))
        self.centre = obs.origin.mean(axis=0)
        origin = obs.origin - self.centre
        self.device = search.device
        self.dtype = torch.float32 if np.abs(origin).max() < _SINGLE_EXTENT else torch.float64
        n, zero, one = obs.direction, np.zeros(len(obs)), np.ones(len(obs))
        self.ahead = self._tensor(np.stack([*n.T, zero, -(n * origin).sum(axis=1)]))
        self.apart2 = self._tensor(np.stack([*(-2 * origin.T), one, (origin**2).sum(axis=1)]))
        self.slope, self.floor = self._tensor(search.gate * obs.sigma**2), search.gate * obs.position_sigma**2 + 1e-9
        across = np.eye(3) - n[:, :, None] * n[:, None, :]
        self.across = self._tensor(across.reshape(-1, 9))
        self.foot = self._tensor((across @ origin[:, :, None])[:, :, 0])
        self.range, self.doubt = None, 0.0
        if np.isfinite(obs.range).any():
            ranged = np.isfinite(obs.range)
            precision = np.where(ranged, 1 / obs.range_sigma, 0.0)
            self.range = self._tensor(np.where(ranged, obs.range, 0.0)), self._tensor(precision)
            self.doubt = 1 - _RANGE_SHARE  # below it a ray may have a wrong range, or be of something behind

    def _tensor(self, values: Floats) -> Tensor:
        return torch.as_tensor(values, dtype=self.dtype, device=self.device).contiguous()

    def load(self, points: Floats) -> Tensor:
        """Points (H, 3) in map as a tensor relative to the middle of the cameras."""
        return self._tensor(points - self.centre)

    def unload(self, points: Tensor) -> Floats:
        """The inverse of `load`."""
        return np.asarray(points.double().cpu().numpy() + self.centre)

    def supports(self, points: Tensor) -> Tensor:
        """(H, R): 1 where a ray passes through a point, less with the squared deviation, 0 at the gate."""
        p = torch.cat([points, points.square().sum(1, keepdim=True), torch.ones_like(points[:, :1])], 1)
        out = torch.empty((len(p), self.ahead.shape[1]), dtype=self.dtype, device=self.device)
        step = max(1, _PAIRS_AT_ONCE // self.ahead.shape[1])
        for i in range(0, len(p), step):
            depth = torch.mm(p[i : i + step], self.ahead).clamp_(min=1e-3)  # behind the camera nothing fits
            depth2 = depth.square()
            part = torch.mm(p[i : i + step], self.apart2, out=out[i : i + step])
            part.sub_(depth2).div_(depth2.mul_(self.slope).add_(self.floor)).neg_().add_(1).clamp_(min=0, max=1)
            if self.range is not None:
                wrong = (depth - self.range[0]).mul_(self.range[1] / _RANGE_LIMIT).square_()
                part.mul_(1 - wrong.mul_(_RANGE_SHARE).clamp_(max=_RANGE_SHARE))
        return out

    def per_frame(self, support: Tensor) -> Tensor:
        """(H,) sums over the frames of the best support (H, R) in each."""
        best, at = support[:, : self.slices[0]].clone(), self.slices[0]
        for width in self.slices[1:]:
            torch.maximum(best[:, :width], support[:, at : at + width], out=best[:, :width])
            at += width
        return best.sum(dim=1)

    def refine(self, points: Tensor, support: Tensor) -> Tensor:
        """Points (H, 3) moved to the least squares of their supporters; what those do not fix stays."""
        information = (support @ self.across).reshape(-1, 3, 3)
        damping = (1e-3 * information.diagonal(dim1=1, dim2=2).sum(dim=1) + 1e-6)[:, None]
        information = information + damping[:, :, None] * torch.eye(3, dtype=self.dtype, device=self.device)
        return torch.linalg.solve(information, support @ self.foot + damping * points)
