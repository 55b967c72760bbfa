"""The fits of cuboids from several starts, and the choice between the fits of two shapes."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.choice import log_evidence
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import ENOUGH, STEPS, Fit, Prior, Weights, fit
from objslam.triangulation.bodies.prior import cuboid_prior
from objslam.triangulation.bodies.residuals import Residuals
from objslam.triangulation.bodies.shapes import CUBOID, ELLIPSOID


def cuboid_starts(rounds: Floats) -> tuple[Floats, Floats]:
    """Return two starts (N, 7) of cuboids, along the axes of ellipsoids (N, 7) and at 45 degrees to them."""
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


def mixed_fit(which: Bools, body: Ints, first: Fit, second: Fit) -> Fit:
    """Return the first fit for some bodies (N,), and the second for the others."""
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
