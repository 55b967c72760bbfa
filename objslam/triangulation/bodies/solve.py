"""Find the bodies of all objects of a map: fit, learn the noise and the sizes of labels, and choose a shape for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.choice import log_evidence
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import Fit, Prior, Weights, fit
from objslam.triangulation.bodies.prior import cuboid_prior, dot_prior, known_sizes, label_prior, sphere_prior, weak_prior
from objslam.triangulation.bodies.residuals import Residuals, edge_gaps, residuals
from objslam.triangulation.bodies.shapes import CUBOID, ELLIPSOID
from objslam.triangulation.bodies.shared import (
    covariance_of,
    effective_variance,
    share_of,
    sides_of,
    spread_of,
    white_factors,
)

Measure = Callable[[Floats | None], BoxEdges]
"""The edges of the boxes, given the points (B, 4, 3) in map at which the bodies touch them. None means unknown points."""

_POINT, _SPHERE, _ELLIPSOID, _CUBOID = range(4)
_ROUNDS = 2
"""How often the noise is estimated from the residuals of the last fit. More rounds are slower and change little."""


@dataclass(frozen=True)
class Bodies:
    """The bodies of N objects.

    values: (N, 7) parameters of a cuboid or of an ellipsoid (see `shapes`). covariance: (N, 7, 7). shape: (N,) the chosen
    shape, an index into `core.body.SHAPES`. evidence: (4, N) the logarithm of the evidence of each shape. weight: (B,) the
    robust weight of each box. share: the standard deviation of the error that boxes of one side share, as a share of half
    their size. factors: (2,) on the nominal noise of shifts and sizes.
    """

    values: Floats
    covariance: Floats
    shape: Ints
    evidence: Floats
    weight: Floats
    share: float
    factors: Floats

    @property
    def axes(self) -> Floats:
        """(N, 7) centre, m, half axes, m, and yaw, rad."""
        return self._by_kind("axes")

    @property
    def slope(self) -> Floats:
        """(N, 7, 7) derivatives of `axes` by the parameters."""
        return self._by_kind("slope")

    def _by_kind(self, what: str) -> Floats:
        found = [
            kind.axes_jacobian(self.values)
            if what == "slope"
            else np.column_stack([self.values[:, :3], kind.half_axes(self.values), kind.heading(self.values)])
            for kind in (ELLIPSOID, CUBOID)
        ]
        return _rows(self.shape == _CUBOID, found[1], found[0])


def solve_bodies(
    measure: Measure,
    points: Floats,
    half: Floats,
    names: tuple[str, ...],
    *,
    side: Floats,
    share: float,
    learn: bool = True,
    sizes: Mapping[str, tuple[float, float, float]] | None = None,
    bent: bool = True,
) -> Bodies:
    """Return the bodies of objects at points (N, 3), m, with apparent half axes (N, 2), m, and labels.

    side: (B,) px, half the length of the image. share: the prior of `Bodies.share`. learn: whether the share and the noise
    are estimated. bent: whether the images are distorted, so that the planes of the edges depend on the points of contact.
    """
    edges = measure(None)
    sides = sides_of(edges, points)
    weak = prior = weak_prior(points, half)
    factors, found, values = np.ones(2), share, weak.mean
    label = np.unique(np.array(names), return_inverse=True)[1].ravel()
    for number in range(_ROUNDS + 1):
        now = residuals(edges, values, ELLIPSOID)
        weights = Weights(effective_variance(edges, now, sides, factors, found), spread_of(edges, now, factors, found))
        round_ = fit(edges, values, prior, weights, ELLIPSOID)
        values = round_.values
        square, square_prior = _cuboids(edges, values, prior, weights)
        dots = _dot_evidence(edges, prior, weights, side)
        rounds = log_evidence(edges, round_, prior, weights)
        squares = log_evidence(edges, square, square_prior, weights)
        cuboid, some = squares > rounds, np.maximum(squares, rounds) > dots
        best = _mixed(cuboid, edges.body, square, round_)
        covariance = covariance_of(edges, best, sides, factors, found)
        if number == _ROUNDS:
            break
        # Boxes that show no body, such as marks of one size, say nothing of the noise and the sizes of the others.
        prior = label_prior(weak, best.values, covariance, np.where(some, label, -1), cuboid)
        if sizes:
            prior = known_sizes(prior, values, names, sizes)
        if learn and some.any():
            factors = white_factors(best.found, sides, some[edges.body])
            found = share_of(edges, best, sides, factors, share, some)
        if bent:
            touched = [edge_gaps(edges, one.values, kind)[2] for one, kind in ((square, CUBOID), (round_, ELLIPSOID))]
            edges = measure(_rows(cuboid[edges.body], *touched))
    ball_prior = sphere_prior(prior)
    ball = fit(edges, ball_prior.mean, ball_prior, weights, ELLIPSOID)
    evidence = np.stack([dots, log_evidence(edges, ball, ball_prior, weights), rounds, squares])
    shape = evidence.argmax(axis=0)
    chosen = _rows(shape == _SPHERE, ball.values, best.values)
    robust = _rows((shape == _SPHERE)[edges.body], ball.weight, best.weight)[:, 0] * weights.variance[:, 0]
    return Bodies(chosen, covariance, shape, evidence, robust, found, factors)


def _dot_evidence(edges: BoxEdges, prior: Prior, weights: Weights, side: Floats) -> Floats:
    """Return the logarithm of the evidence (N,) of points, which do not explain the sides of boxes."""
    dots, variance, spread = dot_prior(prior), weights.variance.copy(), weights.spread.copy()
    variance[:, 2:4] = spread[:, 2:4] = np.inf
    found = fit(edges, dots.mean, dots, replace(weights, variance=variance, spread=spread), ELLIPSOID)
    return log_evidence(edges, found, dots, weights, free_side=side)


def _cuboids(edges: BoxEdges, rounds: Floats, prior: Prior, weights: Weights) -> tuple[Fit, Prior]:
    """Return the best cuboids, from starts along the axes of ellipsoids (N, 7) and at 45 degrees to them."""
    fits = []
    for turn in (0.0, np.pi / 4):
        start = rounds.copy()
        start[:, 4], start[:, 5] = np.hypot(rounds[:, 4], rounds[:, 5]) * np.cos(2 * turn), ELLIPSOID.heading(rounds) + turn
        start[:, [3, 6]] -= np.log(2) / 4  # The ellipsoid around a cuboid is larger than the cuboid.
        own = cuboid_prior(prior, start)
        fits.append((fit(edges, start, own, weights, CUBOID), own))
    evidence = [log_evidence(edges, one, own, weights) for one, own in fits]
    turned = evidence[1] > evidence[0]
    best = _mixed(turned, edges.body, fits[1][0], fits[0][0])
    mean, information = (_rows(turned, getattr(fits[1][1], k), getattr(fits[0][1], k)) for k in ("mean", "information"))
    return best, Prior(mean, information)


def _mixed(which: Bools, body: Ints, first: Fit, second: Fit) -> Fit:
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
