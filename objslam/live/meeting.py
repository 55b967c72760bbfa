"""Where rays meet, in a millisecond: for a session, what `triangulation` is for a whole log.

The same consensus of pairs, in numpy, for the few rays of one object: a call of torch alone takes longer than a frame may.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from objslam.association.refit import refit
from objslam.association.sightings import Sightings
from objslam.geometry import widest_angle
from objslam.types import Bools, Floats, Ints

_PAIRS = 300  # pairs of rays tried
_MOST = 60  # rays looked at for the pairs and the parallax
_MISS = 4.0  # standard deviations by which a ray may miss
_APART = np.radians(1.0)  # between two rays that make a pair
_NEAREST = 0.1  # m; an object is no nearer


@dataclass(frozen=True)
class Meeting:
    """position: (3,) m. covariance: (3, 3) m^2. parallax: rad, of the rays that agree. agree: (R,) which those are."""

    position: Floats
    covariance: Floats
    parallax: float
    agree: Bools


def sightings(
    origin: Floats, direction: Floats, sigma: Floats, range_: Floats, range_sigma: Floats, label: Ints | None = None
) -> Sightings:
    """Rays (R,) in map as sightings, all of one frame, with nothing but where they point."""
    zero, minus, one, size, box = _nothing(len(origin))
    return Sightings(
        frame=zero,
        label=zero if label is None else label,
        origin=origin,
        direction=direction,
        sigma=sigma,
        place=0.0,
        range=range_,
        range_sigma=range_sigma,
        size=size,
        box=box,
        track=minus,
        score=one,
    )


@lru_cache(maxsize=256)
def _nothing(count: int) -> tuple[Ints, Ints, Floats, Floats, Floats]:
    zero = np.zeros(count, dtype=np.int64)
    columns = zero, zero - 1, np.ones(count), np.zeros((count, 2)), np.zeros((count, 4))
    for column in columns:
        column.flags.writeable = False
    return columns


def meet(s: Sightings, rng: np.random.Generator, slack: float = 0.0) -> Meeting | None:
    """Where most of the rays agree; None where no two rays do. slack: m, of the origins against each other."""
    start = _consensus(s, rng, slack)
    if start is None:
        return None
    agree = misses(s, start, slack) < _MISS
    for _ in range(2):
        if agree.sum() < 2:
            return None
        held, before = np.flatnonzero(agree), agree
        start = refit(s, held, np.zeros(len(held), dtype=np.int64), start[None], np.ones(1))[0]
        agree = misses(s, start, slack) < _MISS
        if (agree == before).all():
            break
    if agree.sum() < 2:
        return None
    held = np.flatnonzero(agree)
    some = held[np.linspace(0, len(held) - 1, min(len(held), _MOST)).astype(np.int64)]
    inner = s.take(held)
    covariance = np.linalg.inv(information(inner, start).sum(axis=0) + 1e-4 * np.eye(3))
    off = misses(inner, start, slack)
    covariance *= max(1.0, float(np.mean(off**2)) / 2)
    return Meeting(start, covariance, widest_angle(s.direction[some]), agree)


def misses(s: Sightings, point: Floats, slack: float = 0.0) -> Floats:
    """By how many standard deviations each ray (R,) misses its point, (R, 3) or (3,); inf where that is behind it."""
    to = point - s.origin
    depth = np.einsum("ri,ri->r", to, s.direction)
    distance2 = np.einsum("ri,ri->r", to, to)
    across = np.sqrt(np.maximum(distance2 - depth**2, 0.0))
    off = across / np.sqrt(s.sigma**2 * distance2 + slack**2 + 1e-18)
    return np.where(depth > _NEAREST, off, np.inf)


def information(s: Sightings, point: Floats) -> Floats:
    """What each ray (R, 3, 3), m^-2, says about where its point, (R, 3) or (3,), is."""
    to = point - s.origin
    distance = np.linalg.norm(to, axis=1)
    n = s.direction
    along = n[:, :, None] * n[:, None, :]
    across = (np.eye(3) - along) / (s.sigma * np.maximum(distance, _NEAREST))[:, None, None] ** 2
    weight = np.where(np.isfinite(s.range), 1 / s.range_sigma**2, 0.0)
    return across + np.nan_to_num(weight)[:, None, None] * along


def _consensus(s: Sightings, rng: np.random.Generator, slack: float) -> Floats | None:
    """The point that most rays agree on, among those where two rays meet or where a range ends."""
    count = len(s)
    some = np.arange(count) if count <= _MOST else np.sort(rng.permutation(count)[:_MOST])
    a, b = (some[i] for i in np.triu_indices(len(some), 1))
    if len(a) > _PAIRS:
        pick = rng.permutation(len(a))[:_PAIRS]
        a, b = a[pick], b[pick]
    points = [_midpoints(s, a, b)]
    ranged = some[np.isfinite(s.range[some])]
    points.append(s.origin[ranged] + s.range[ranged, None] * s.direction[ranged])
    tried = np.concatenate(points)
    if not len(tried):
        return None
    to = tried[:, None] - s.origin  # (H, R, 3)
    depth = np.einsum("hri,ri->hr", to, s.direction)
    distance2 = np.einsum("hri,hri->hr", to, to)
    off2 = np.maximum(distance2 - depth**2, 0.0) / (s.sigma**2 * distance2 + slack**2 + 1e-18)
    cost = np.where(depth > _NEAREST, np.minimum(off2, _MISS**2), _MISS**2)
    with np.errstate(invalid="ignore"):
        wrong = ((np.sqrt(distance2) - s.range) / s.range_sigma) ** 2
    cost = cost + np.where(np.isfinite(wrong), np.minimum(wrong, _MISS**2) / 2, 0.0)
    return np.asarray(tried[cost.sum(axis=1).argmin()])


def _midpoints(s: Sightings, a: Ints, b: Ints) -> Floats:
    """Where pairs of rays (P,) come closest, those that do so ahead of both and not at a sharp angle."""
    m, n, o, p = s.origin[a], s.direction[a], s.origin[b], s.direction[b]
    cos = np.einsum("pi,pi->p", n, p)
    sharp = 1 - cos**2
    between = o - m
    along_n, along_p = np.einsum("pi,pi->p", between, n), np.einsum("pi,pi->p", between, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s_n = (along_n - cos * along_p) / sharp
        s_p = (cos * along_n - along_p) / sharp
    fine = (sharp > np.sin(_APART) ** 2) & (s_n > _NEAREST) & (s_p > _NEAREST)
    ahead, on = s_n[fine, None] * n[fine], s_p[fine, None] * p[fine]
    return np.asarray((m[fine] + ahead + o[fine] + on) / 2)
