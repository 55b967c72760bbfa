"""Points from the rays that were given to them, all at once."""

from __future__ import annotations

import numpy as np

from objslam.association.sightings import Sightings
from objslam.types import Floats, Ints

_CAUCHY2 = 6.0


def refit(s: Sightings, index: Ints, start: Floats, noise: Floats, iterations: int = 6) -> tuple[Floats, Floats]:
    """Positions (N,3), covariance (N,3,3)."""
    held = np.flatnonzero(index >= 0)
    order = held[np.argsort(index[held], kind="stable")]
    r, o = s.take(order), index[order]
    count = len(start)
    position = start.copy()
    P = np.eye(3) - r.direction[:, :, None] * r.direction[:, None, :]
    N = r.direction[:, :, None] * r.direction[:, None, :]
    for _ in range(iterations):
        to = position[o] - r.origin
        d2 = np.maximum((to * to).sum(1), 1e-4)
        depth = (to * r.direction).sum(1)
        off = to - depth[:, None] * r.direction
        var = (r.sigma * noise[o]) ** 2 * d2 + r.place**2
        m2 = (off * off).sum(1) / var
        w = 1 / var / (1 + m2 / _CAUCHY2)
        rr = (depth - r.range) / r.range_sigma
        wr = np.where(np.isfinite(rr), 1 / r.range_sigma**2 / (1 + rr**2 / 3.0) ** 2, 0.0)
        A = w[:, None, None] * P + wr[:, None, None] * N
        b = -w[:, None] * off + (np.where(np.isfinite(rr), wr * (r.range - depth), 0.0))[:, None] * r.direction
        A = _sums(A.reshape(-1, 9), o, count).reshape(-1, 3, 3)
        b = _sums(b, o, count)
        trace = np.trace(A, axis1=1, axis2=2)
        damp = 1e-6 * trace + 1e-12
        step = np.linalg.solve(A + damp[:, None, None] * np.eye(3), b[:, :, None])[:, :, 0]
        position = position + step
    cov = np.linalg.inv(A + damp[:, None, None] * np.eye(3))
    return position, cov


def _sums(values: Floats, index: Ints, count: int) -> Floats:
    return np.stack([np.bincount(index, values[:, i], count) for i in range(values.shape[1])], axis=1)
