"""Where could objects be? Points that many rays of one label agree on, found from pairs of rays, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objslam.association.sightings import MIN_DEPTH, Sightings
from objslam.threads import one_torch_thread
from objslam.types import Floats, Ints

_CHUNK = 1 << 18  # pairs of a ray and a point at a time: what the processor's cache holds
_DRAWS = 8  # pairs drawn for each hypothesis wanted: most do not meet
_REFINED = 2
_COMPETES = 0.6  # a hypothesis that others have robbed of more than this leaves has to wait for the next round
_SINGLE_EXTENT = 30.0  # m; beyond it single precision loses millimetres
_RANGE_LIMIT, _RANGE_SHARE = 3.0, 0.6  # standard deviations off, and the most that a wrong range takes from a support
_LADDER = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0)  # m; where to look along rays that have no parallax


@dataclass(frozen=True)
class Search:
    """How to search: hypotheses at a time, at least `support` rays to each point, gate (squared deviations), the parallax
    (rad) of a pair (0: points anywhere along single rays too), and the device."""

    hypotheses: int
    support: float
    gate: float
    parallax: float
    device: str


def discover(s: Sightings, search: Search, rng: np.random.Generator) -> Floats:
    """Points (N, 3), m, that rays of one label agree on, the best supported first, none living on the rays of a better one.

    Each of `hypotheses` points is scored against all rays at once: one ray a frame, 1 for a perfect fit, 0 at the gate.
    """
    points = _propose(s, search, rng)
    if len(points) == 0:
        return points
    with one_torch_thread():
        return _best(points, _Scorer(s, search), search.support)


def _best(points: Floats, scorer: _Scorer, least: float) -> Floats:
    """The points that rays agree on, refined, best first; each has at least `least` support that no better one took."""
    moved = scorer.load(points)
    for _ in range(_REFINED):
        moved = scorer.refine(moved, scorer.supports(moved))
    support = scorer.supports(moved)
    whole = scorer.per_frame(support)
    left, found = whole.clone(), []
    for _ in range(len(moved)):
        best = int(torch.where(left >= _COMPETES * whole, left, 0.0).argmax())
        if float(left[best]) < max(least, _COMPETES * float(whole[best])):
            break
        found.append(best)
        taken = support[best] > scorer.doubt
        left -= support[:, taken].sum(dim=1)
        support[:, taken] = 0.0
    return scorer.unload(moved[found])


def _propose(s: Sightings, search: Search, rng: np.random.Generator) -> Floats:
    """Points (H, 3): where two rays of different frames meet, and where measured ranges end."""
    first, second = _draw(s, _DRAWS * search.hypotheses, rng)
    n1, n2 = s.direction[first], s.direction[second]
    between = s.origin[second] - s.origin[first]
    cos = np.einsum("ri,ri->r", n1, n2)
    sin2 = np.maximum(np.einsum("ri,ri->r", np.cross(n1, n2), np.cross(n1, n2)), 1e-12)
    a, b = np.einsum("ri,ri->r", between, n1), np.einsum("ri,ri->r", between, n2)
    depth1, depth2 = (a - cos * b) / sin2, (cos * a - b) / sin2
    one = s.origin[first] + depth1[:, None] * n1
    two = s.origin[second] + depth2[:, None] * n2
    apart2 = ((one - two) ** 2).sum(axis=1)
    limit = (s.sigma[first] * depth1) ** 2 + (s.sigma[second] * depth2) ** 2 + 2 * s.place**2
    meet = (depth1 > MIN_DEPTH) & (depth2 > MIN_DEPTH) & (apart2 <= search.gate * limit)
    meet &= (s.frame[first] != s.frame[second]) & (sin2 >= max(np.sin(search.parallax), 1e-3) ** 2)
    points = [((one + two) / 2)[meet][: search.hypotheses]]
    ranged = np.flatnonzero(np.isfinite(s.range))
    if len(ranged):
        some = rng.permutation(ranged)[: search.hypotheses // 2]
        points.append(s.origin[some] + s.range[some, None] * s.direction[some])
    if search.parallax == 0:
        some = rng.permutation(len(s))[: search.hypotheses // len(_LADDER)]
        ladder = np.array(_LADDER)[:, None, None] * s.direction[some]
        points.append((s.origin[some] + ladder).reshape(-1, 3))
    return np.concatenate(points)


def _draw(s: Sightings, count: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Pairs of rays; the second from the first's track where it has one (every other time), else from frames near and far.

    How far off, is spread evenly over the orders of magnitude: a near frame more likely shows the same object.
    """
    n = len(s)
    first = rng.integers(n, size=count)
    reach = np.exp(rng.uniform(0.0, np.log(max(n, 2)), count)).astype(np.int64)
    second = first + reach * rng.choice([-1, 1], count)
    second = np.where((second < 0) | (second >= n), first - (second - first), second)
    order = np.argsort(s.track, kind="stable")
    sorted_tracks = s.track[order]
    begin, end = (np.searchsorted(sorted_tracks, s.track[first], side=side) for side in ("left", "right"))
    mate = order[begin + (rng.random(count) * (end - begin)).astype(np.int64)]
    second = np.where((s.track[first] >= 0) & (rng.random(count) < 0.5), mate, second)
    inside = (second >= 0) & (second < n)
    return first[inside], second[inside]


class _Scorer:
    """Rays of one label, laid out so that the best ray of each frame is a running maximum over slices.

    Rays stand in the order of their rank in their frame, and frames in the order of how many rays they have: for every k
    those with more than k rays come first.
    """

    def __init__(self, s: Sightings, search: Search) -> None:
        _, frame, number = np.unique(s.frame, return_inverse=True, return_counts=True)
        rank = np.arange(len(s)) - (np.cumsum(number) - number)[frame]  # the rays of a frame stand together
        self.slices = np.bincount(rank).tolist()
        s = s.take(np.lexsort((frame, -number[frame], rank)))
        self.centre = s.origin.mean(axis=0)
        origin = s.origin - self.centre
        self.device = search.device
        self.dtype = torch.float32 if np.abs(origin).max() < _SINGLE_EXTENT else torch.float64
        n, zero, one = s.direction, np.zeros(len(s)), np.ones(len(s))
        self.ahead = self._tensor(np.stack([*n.T, zero, -(n * origin).sum(axis=1)]))
        self.apart2 = self._tensor(np.stack([*(-2 * origin.T), one, (origin**2).sum(axis=1)]))
        self.slope, self.floor = self._tensor(search.gate * s.sigma**2), search.gate * s.place**2 + 1e-9
        across = np.eye(3) - n[:, :, None] * n[:, None, :]
        self.across = self._tensor(across.reshape(-1, 9))
        self.foot = self._tensor((across @ origin[:, :, None])[:, :, 0])
        self.range, self.doubt = None, 0.0
        if np.isfinite(s.range).any():
            ranged = np.isfinite(s.range)
            precision = np.where(ranged, 1 / s.range_sigma, 0.0)
            self.range = self._tensor(np.where(ranged, s.range, 0.0)), self._tensor(precision)
            self.doubt = 1 - _RANGE_SHARE  # a ray with less support may have a wrong range, or belong to something behind

    def _tensor(self, values: Floats) -> Tensor:
        return torch.as_tensor(values, dtype=self.dtype, device=self.device).contiguous()

    def load(self, points: Floats) -> Tensor:
        """Points (H, 3) in map as the scorer wants them."""
        return self._tensor(points - self.centre)

    def unload(self, points: Tensor) -> Floats:
        """The inverse of `load`."""
        return np.asarray(points.double().cpu().numpy() + self.centre)

    def supports(self, points: Tensor) -> Tensor:
        """(H, R): 1 where a ray passes through a point, falling with the squared deviation to 0 at the gate."""
        p = torch.cat([points, points.square().sum(1, keepdim=True), torch.ones_like(points[:, :1])], 1)
        out = torch.empty((len(p), self.ahead.shape[1]), dtype=self.dtype, device=self.device)
        step = max(1, _CHUNK // self.ahead.shape[1])
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
        """Points (H, 3) moved to the least squares of their supporters; where those do not fix a point, it stays."""
        information = (support @ self.across).reshape(-1, 3, 3)
        damping = (1e-3 * information.diagonal(dim1=1, dim2=2).sum(dim=1) + 1e-6)[:, None]
        information = information + damping[:, :, None] * torch.eye(3, dtype=self.dtype, device=self.device)
        return torch.linalg.solve(information, support @ self.foot + damping * points)
