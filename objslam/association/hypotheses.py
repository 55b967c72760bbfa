"""Where could objects be? Points that many rays of one label agree on, found from pairs of rays, in torch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from objslam.association.sightings import MIN_DEPTH, Sightings
from objslam.types import Floats, Ints

_CHUNK = 1 << 18


def propose(s: Sightings, count: int, min_parallax: float, gate: float, rng: np.random.Generator) -> Floats:
    """Points (H, 3), H <= count."""
    n = len(s)
    draws = 8 * count
    first = rng.integers(n, size=draws)
    # offsets spread evenly over the orders of magnitude: near frames show the same object more often than not
    reach = np.exp(rng.uniform(0.0, np.log(max(n, 2)), draws)).astype(np.int64)
    second = first + reach * rng.choice([-1, 1], draws)
    valid = (second >= 0) & (second < n)
    first, second = first[valid], second[valid]
    n1, n2 = s.direction[first], s.direction[second]
    between = s.origin[second] - s.origin[first]
    cos = (n1 * n2).sum(1)
    sin2 = np.maximum(1 - cos**2, 1e-12)
    a, b = (between * n1).sum(1), (between * n2).sum(1)
    t1, t2 = (a - cos * b) / sin2, (cos * a - b) / sin2
    p1, p2 = s.origin[first] + t1[:, None] * n1, s.origin[second] + t2[:, None] * n2
    miss2 = ((p1 - p2) ** 2).sum(1)
    limit = s.sigma[first] ** 2 * t1**2 + s.sigma[second] ** 2 * t2**2 + 2 * s.place**2
    ok = (np.sqrt(sin2) >= np.sin(min_parallax)) & (t1 > MIN_DEPTH) & (t2 > MIN_DEPTH) & (miss2 <= gate * limit)
    ok &= s.frame[first] != s.frame[second]
    points = ((p1 + p2) / 2)[ok]
    ranged = np.flatnonzero(np.isfinite(s.range))
    if len(ranged):
        some = rng.choice(ranged, min(len(ranged), count // 2), replace=False)
        points = np.concatenate([s.origin[some] + s.range[some, None] * s.direction[some], points])
    return points[:count]


class Scorer:
    """Rays of one label laid out so that the best ray of each frame is a running maximum over slices.

    Rays are sorted by their rank in their frame, and frames by how many rays they have: those with more than k rays are the
    first ones for every k.
    """

    def __init__(self, s: Sightings, gate: float, device: str) -> None:
        _, frame, number = np.unique(s.frame, return_inverse=True, return_counts=True)
        start = np.cumsum(number) - number
        rank = np.arange(len(s)) - start[frame]  # rays of a frame stand together
        self.order = np.lexsort((frame, -number[frame], rank))
        self.slices = np.bincount(rank).tolist()
        s = s.take(self.order)
        self.centre = s.origin.mean(axis=0)
        origin = s.origin - self.centre
        dtype = torch.float32 if np.abs(origin).max() < 30 else torch.float64
        t = lambda a: torch.as_tensor(a, dtype=dtype, device=device)
        self.n, self.m = t(s.direction), t(origin)
        ones, zeros = torch.ones_like(self.n[:, :1]), torch.zeros_like(self.n[:, :1])
        self.ahead = torch.cat([self.n, zeros, -(self.n * self.m).sum(1, keepdim=True)], 1).T.contiguous()
        self.apart = torch.cat([-2 * self.m, ones, (self.m * self.m).sum(1, keepdim=True)], 1).T.contiguous()
        self.slope, self.floor = t(gate * s.sigma**2), gate * s.place**2 + 1e-12
        self.projector = t((np.eye(3) - s.direction[:, :, None] * s.direction[:, None, :]).reshape(-1, 9))
        self.foot = (self.projector.reshape(-1, 3, 3) @ self.m[:, :, None])[:, :, 0]
        self.range = None
        if np.isfinite(s.range).any():
            self.range = t(np.nan_to_num(s.range)), t(np.where(np.isfinite(s.range), 1 / s.range_sigma, 0.0))

    def supports(self, points: Tensor) -> Tensor:
        """(H, R): 1 where a ray passes through a point, falling with the square of the deviation to 0 at the gate."""
        q = torch.cat([points, (points * points).sum(1, keepdim=True), torch.ones_like(points[:, :1])], 1)
        out = torch.empty((len(points), self.n.shape[0]), dtype=points.dtype, device=points.device)
        step = max(1, _CHUNK // self.n.shape[0])
        for i in range(0, len(points), step):
            depth = (q[i : i + step] @ self.ahead).clamp_(min=1e-3)
            depth2 = depth.square()
            part = torch.mm(q[i : i + step], self.apart, out=out[i : i + step])
            part.sub_(depth2).div_(depth2.mul_(self.slope).add_(self.floor)).neg_().add_(1).clamp_(min=0, max=1)
            if self.range is not None:
                wrong = ((depth - self.range[0]) * self.range[1]).square_().mul_(1 / 9).clamp_(max=0.6)
                part.mul_(1 - wrong)
        return out

    def per_frame(self, support: Tensor) -> Tensor:
        """(H,) sums over frames of the best support (H, R) in each."""
        best = support[:, : self.slices[0]].clone()
        at = self.slices[0]
        for width in self.slices[1:]:
            torch.maximum(best[:, :width], support[:, at : at + width], out=best[:, :width])
            at += width
        return best.sum(1)

    def refine(self, points: Tensor, support: Tensor) -> Tensor:
        """Each point moved to the weighted least squares of its supporters."""
        depth2 = (points[:, None] - self.m[None]).square().sum(-1) if False else None
        w = support
        A = (w @ self.projector).reshape(-1, 3, 3)
        b = w @ self.foot
        trace = A.diagonal(dim1=1, dim2=2).sum(1)
        damp = (1e-3 * trace + 1e-6)[:, None]
        A = A + damp[:, :, None] * torch.eye(3, dtype=A.dtype, device=A.device)
        return torch.linalg.solve(A, b + damp * points)


def discover(s: Sightings, count: int, least: float, gate: float, min_parallax: float, device: str, rng) -> Floats:
    points = propose(s, count, min_parallax, gate, rng)
    if not len(points):
        return np.zeros((0, 3))
    scorer = Scorer(s, gate, device)
    p = torch.as_tensor(points - scorer.centre, dtype=scorer.n.dtype, device=device)
    for _ in range(2):
        support = scorer.supports(p)
        p = scorer.refine(p, support)
    support = scorer.supports(p)
    full = scorer.per_frame(support)
    left = full.clone()
    found = []
    for _ in range(len(p)):
        best = int(torch.argmax(torch.where(left >= 0.6 * full, left, 0.0)))
        if float(left[best]) < least or float(left[best]) < 0.6 * float(full[best]):
            break
        found.append(best)
        taken = support[best] > 0
        left = left - support[:, taken].sum(1)
        support[:, taken] = 0
        left[best] = 0
    return p[found].double().cpu().numpy() + scorer.centre
