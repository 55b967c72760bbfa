"""Fit cuboids from several starts, and join the fits of two shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.choice import log_evidence
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import ENOUGH, STEPS, Fit, Prior, Weights, fit
from objslam.triangulation.bodies.prior import cuboid_prior
from objslam.triangulation.bodies.residuals import Residuals
from objslam.triangulation.bodies.shapes import CUBOID, ELLIPSOID

_TURNS = np.radians([0.0, 22.5, 45.0, 67.5])
"""The headings (rad), relative to the best cuboid so far, at which fits of cuboids start. Each start has a square section,
which repeats after a quarter turn. In simulations of things seen over 30 degrees, four headings always found the best
cuboid, and two headings missed it for one thing in 20. More headings are slower."""
_ONE_SIDE = np.radians(35.0)
"""The largest angle (rad) between a view and the mean view of a thing that was seen from one side only. In simulations,
cuboids seen over 60 degrees and more had one clear heading. With a larger angle, other headings are tried for more
things."""
_RIVAL = 15.0
"""The lead of another shape in the logarithm of the evidence, above which no other headings of a cuboid are tried. Another
heading has raised the logarithm by up to 11. With a larger number, other headings are tried for more things."""
_SAME = 0.005
"""The difference (m) of each centre coordinate and half axis below which two cuboids count as one. A larger length merges
more cuboids."""


@dataclass(frozen=True)
class OtherCuboids:
    """M other cuboids for each of N bodies.

    values: (M, N, 7) the parameters. evidence: (M, N) the logarithm of the evidence of each cuboid, -inf for a cuboid that
    is missing or the same as another one.
    """

    values: Floats
    evidence: Floats

    @property
    def axes(self) -> Floats:
        """(M, N, 6) the centres and half axes of the cuboids, m."""
        axes = [np.column_stack([one[:, :3], CUBOID.half_axes(one)]) for one in self.values]
        return np.stack(axes) if axes else np.zeros((*self.evidence.shape, 6))

    @classmethod
    def none(cls, count: int) -> OtherCuboids:
        return cls(np.zeros((0, count, 7)), np.zeros((0, count)))


def cuboid_starts(rounds: Floats) -> tuple[Floats, Floats]:
    """Return two starts (N, 7) of cuboids: along the axes of ellipsoids (N, 7), and at 45 degrees to these axes."""
    starts = []
    for turn in (0.0, np.pi / 4):
        start = rounds.copy()
        start[:, 4], start[:, 5] = np.hypot(rounds[:, 4], rounds[:, 5]) * np.cos(2 * turn), ELLIPSOID.heading(rounds) + turn
        start[:, [3, 6]] -= np.log(2) / 4  # The ellipsoid around a cuboid is larger than the cuboid.
        starts.append(start)
    return starts[0], starts[1]


def best_cuboids(
    edges: BoxEdges, starts: tuple[Floats, ...], prior: Prior, weights: Weights, side: Floats
) -> tuple[Fit, Prior]:
    """Fit cuboids from each of the starts (N, 7). Return the cuboids with the most evidence, and their priors.

    side: (B,) as in `log_evidence`.
    """
    best: tuple[Fit, Prior, Floats] | None = None
    for start in starts:
        own = cuboid_prior(prior, start)
        found = fit(edges, start, own, weights, CUBOID, still=ENOUGH, most=STEPS)
        evidence = log_evidence(edges, found, own, weights, side)
        if best is None:
            best = found, own, evidence
            continue
        turned = evidence > best[2]
        mean, information = (_rows(turned, getattr(own, k), getattr(best[1], k)) for k in ("mean", "information"))
        best = mixed_fit(turned, edges.body, found, best[0]), Prior(mean, information), np.maximum(evidence, best[2])
    assert best is not None
    return best[0], best[1]


def seen_from_one_side(edges: BoxEdges, centre: Floats) -> Bools:
    """Return which bodies (N,) with centres (N, 3), m, were seen from one side only, as seen from above."""
    towards = (centre[edges.body] - edges.origin)[:, :2]
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    mean = np.stack([np.bincount(edges.body, part, len(centre)) for part in towards.T], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    beside = (towards * mean[edges.body]).sum(axis=1) < np.cos(_ONE_SIDE)
    return np.asarray(np.bincount(edges.body, beside, len(centre)) == 0)


def all_headings(
    edges: BoxEdges, found: Fit, evidence: Floats, rival: Floats, prior: Prior, weights: Weights, side: Floats
) -> tuple[Fit, Floats, OtherCuboids]:
    """Search for better cuboids at other headings, for things that were seen from one side.

    The boxes of such a thing fit cuboids with several headings and depths. A fit ends at one such cuboid, and this
    cuboid may be far less probable than another one.

    Args:
        found: the fits of the cuboids so far.
        evidence: (N,) the logarithm of their evidence.
        rival: (N,) the logarithm of the evidence of the best other shape.
        prior: the prior of ellipsoids.
        side: (B,) as in `log_evidence`.

    Returns:
        The best cuboids, the logarithm (N,) of their evidence, and the other cuboids.
    """
    which = np.flatnonzero((evidence > rival - _RIVAL) & seen_from_one_side(edges, found.values[:, :3]))
    if not len(which):
        return found, evidence, OtherCuboids.none(len(evidence))
    boxes = np.flatnonzero(np.isin(edges.body, which))
    some = replace(edges.take(boxes), body=np.searchsorted(which, edges.body[boxes]))
    its_prior, its_side = Prior(prior.mean[which], prior.information[which]), side[boxes]
    its_weights = Weights(weights.variance[boxes], weights.spread[boxes], weights.robust)
    others = OtherCuboids(np.tile(found.values, (1 + len(_TURNS), 1, 1)), np.full((1 + len(_TURNS), len(evidence)), -np.inf))
    others.evidence[0] = evidence
    for at, turn in enumerate(_TURNS, start=1):
        start = found.values[which].copy()
        start[:, 4] = 0.0
        start[:, 5] += turn
        tried, _ = best_cuboids(some, (start,), its_prior, its_weights, its_side)
        others.values[at, which] = tried.values
        others.evidence[at, which] = log_evidence(some, tried, cuboid_prior(its_prior, start), its_weights, its_side)
    chosen = others.evidence.argmax(axis=0), np.arange(len(evidence))
    own = cuboid_prior(prior, others.values[chosen])
    found = fit(edges, others.values[chosen], own, weights, CUBOID, most=0)
    best_evidence = others.evidence[chosen]
    others.evidence[_repeated(others, chosen[0])] = -np.inf
    return found, best_evidence, others


def _repeated(others: OtherCuboids, chosen: Ints) -> Bools:
    """Return a mask (M, N) of the cuboids that equal the chosen cuboid or an earlier one."""
    axes = others.axes
    same = np.abs(axes[:, None] - axes[None]).max(axis=3) < _SAME  # (M, M, N)
    repeated = np.array([same[at, :at].any(axis=0) for at in range(len(axes))])
    return repeated | same[chosen, :, np.arange(len(chosen))].T


def mixed_fit(which: Bools, body: Ints, first: Fit, second: Fit) -> Fit:
    """Return a fit with the bodies `which` (N,) of the first fit, and the other bodies of the second."""
    boxes = which[body]
    found = Residuals(
        *(_rows(boxes, a, b) for a, b in zip(vars(first.found).values(), vars(second.found).values(), strict=True))
    )
    weight = _rows(boxes, first.weight, second.weight)
    rest = (_rows(which, getattr(first, k), getattr(second, k)) for k in ("values", "information", "prior"))
    values, information, prior = rest
    return Fit(values, weight, found, information, prior)


def _rows(which: Bools, first: Floats, second: Floats) -> Floats:
    return np.where(which.reshape(-1, *[1] * (first.ndim - 1)), first, second)
