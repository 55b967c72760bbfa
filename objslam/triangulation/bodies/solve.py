"""Find the bodies of all objects of a map.

Bodies of all shapes are fitted, the noise and the sizes of labels are learned, and a shape is chosen for each object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import SHAPES
from objslam.triangulation.bodies.choice import log_evidence, shapes_disagree, with_shares_of_shapes
from objslam.triangulation.bodies.cuboid_fits import OtherCuboids, all_headings, best_cuboids, cuboid_starts, mixed_fit
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import ENOUGH, STEPS, Fit, Prior, Weights, fit
from objslam.triangulation.bodies.hidden_edges import hidden_edges, unseen_ends, with_hidden
from objslam.triangulation.bodies.prior import cuboid_prior, dot_prior, known_sizes, label_prior, sphere_prior, weak_prior
from objslam.triangulation.bodies.residuals import residuals_of_shapes, touched_points, whole_axes
from objslam.triangulation.bodies.shapes import CYLINDER, ELLIPSOID, KINDS, rows_of_kinds
from objslam.triangulation.bodies.shared import (
    Sides,
    covariance_of,
    covariance_with_unlike,
    share_of,
    sides_of,
    some_of_each_side,
    weights_of,
    white_factors,
)
from objslam.triangulation.bodies.to_centre import directions_to_centres, shifts_of

Measure = Callable[[Floats | None], BoxEdges]
"""A function that returns the edges of boxes, given points (B, 4, P, 3), m, in map at which bodies may touch the edges.

None means that the points are unknown."""
More = Callable[["Bodies"], "BoxEdges | None"]
"""A function that returns more edges, which can only be found with the bodies, such as the edges of boxes that are cut off.
It returns None if it finds no more edges."""

_POINT, _SPHERE, _ELLIPSOID, _CUBOID, _CYLINDER = range(5)
_SOLID = (_ELLIPSOID, _CUBOID, _CYLINDER)
"""The shapes with three free half axes."""
_ROUNDS = 2
"""The number of rounds in which the noise is estimated from the residuals of the last fit. More rounds are slower and change
little."""
_PER_SIDE = 3
"""The most boxes from each side of an object that are used to find shape and noise. Boxes from one side repeat one error, so
more boxes are slower and hardly help. The last fit uses all boxes."""
_RARE = 20.0
"""The prior odds against a sphere, because few things are balls. With larger odds, fewer bodies are spheres."""


@dataclass(frozen=True)
class Bodies:
    """The bodies of N objects.

    values: (N, 7) the parameters of the body's kind (see `shapes`). covariance: (N, 7, 7), of the parameters. shape: (N,) 0
    point, 1 sphere, 2 ellipsoid, 3 cuboid, 4 cylinder. evidence: (5, N) the logarithm of the evidence of each shape, plus
    the logarithm of the share of the shape (`with_shares_of_shapes`). weight: (B,) the robust weight of each box. share:
    (2,) the standard deviations of the errors of shift and size that boxes of one side share, as shares of half their size.
    factors: (2,) on the nominal noise of shifts and sizes. to_centre: (B, 3) the unit direction in map to the centre of each
    body, minus the unit direction to the centre of its predicted box. It is 0 for a point. hidden: (B, 2) the number of
    edges on each axis that are bounds. between_shapes: (N, 6, 6) m^2, the second moment of centre and half axes over the
    shapes, about the chosen shape. It also contains the doubt about hidden edges and unseen ends. It is not in `covariance`.
    unlike: (N, 7, 7) what must be added to `covariance` because no thing has exactly the shape of its body.
    """

    values: Floats
    covariance: Floats
    shape: Ints
    evidence: Floats
    weight: Floats
    share: Floats
    factors: Floats
    to_centre: Floats
    hidden: Ints
    between_shapes: Floats
    unlike: Floats

    @property
    def axes(self) -> Floats:
        """(N, 7) centre, m, half axes, m, and yaw, rad."""
        axes = np.empty_like(self.values)
        for kind, rows in rows_of_kinds(self.shape):
            some = self.values[rows]
            axes[rows] = np.column_stack([some[:, :3], kind.half_axes(some), kind.heading(some)])
        return axes

    @property
    def centre_covariance(self) -> Floats:
        """(N, 3, 3) m^2, the covariances of the centres: those of the chosen shape, plus `between_shapes`."""
        return self.covariance[:, :3, :3] + self.between_shapes[:, :3, :3]

    @property
    def slope(self) -> Floats:
        """(N, 7, 7) derivatives of `axes` by the parameters."""
        slope = np.empty_like(self.covariance)
        for kind, rows in rows_of_kinds(self.shape):
            slope[rows] = kind.axes_jacobian(self.values[rows])
        return slope


@dataclass(frozen=True)
class _State:
    """The noise, the prior and the bodies of the rounds so far.

    factors, share: as in `Bodies`. prior: the prior of ellipsoids. fitted: for each shape, its bodies (N, 7), at which the
    next fit starts. evidence, shape: as in `Bodies`. solid: (N,) the best of the solid shapes (`_SOLID`). best: the fit of
    this shape, None before the first round. covariance: (N, 7, 7) of `best`. sized: (N,) whether the size is known, so that
    no sphere is chosen. others: the less probable cuboids of the last round.
    """

    factors: Floats
    share: Floats
    prior: Prior
    fitted: tuple[Floats, ...]
    evidence: Floats
    shape: Ints
    solid: Ints
    best: Fit | None
    covariance: Floats
    sized: Bools
    others: OtherCuboids


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
    more: More | None = None,
) -> Bodies:
    """Return the bodies of objects at points (N, 3), m, with apparent half axes (N, 2), m, and labels.

    The shapes, the noise and the sizes of labels come from the edges of `measure` alone. If `more` finds more edges, the
    bodies with such edges are fitted once more, to all edges. Each round finds the edges beyond which a part of the body is
    hidden (`hidden_edges`). These edges are bounds in the next round.

    names: the label of each object. side: (B,) px, half the length of the image. share: the scale of the prior of
    `Bodies.share`. learn: whether the share and the noise are estimated. sizes: known length, width and height, m, by label.
    bent: whether the images are distorted, so that `measure` depends on the points.
    """
    edges = measure(None)
    sides = sides_of(edges, points)
    few = some_of_each_side(sides, _PER_SIDE)
    label = np.unique(np.array(names), return_inverse=True)[1].ravel()
    weak = weak_prior(points, half)
    count, none = len(points), np.zeros(len(points), dtype=np.int64)
    starts = dot_prior(weak).mean, sphere_prior(weak).mean, *[weak.mean] * len(_SOLID)
    nothing = np.zeros((len(SHAPES), count)), none, none, None, np.zeros((count, 7, 7))
    sized = np.array([name in (sizes or {}) for name in names])
    now = _State(np.ones(2), np.full(2, share), weak, starts, *nothing, sized, OtherCuboids.none(count))
    hidden = np.zeros((len(edges), 4), dtype=bool)
    for number in range(_ROUNDS + 1):
        some = with_hidden(edges, hidden).take(few)
        now = _round(some, sides_of(some, points, _counted(some, now)), now, side[few], label, turn=number == _ROUNDS)
        best = now.best
        assert best is not None
        # An object that fits a point best has no size to learn from, such as a mark that is always drawn at one size.
        which, solid = now.shape != _POINT, np.where(np.isin(now.shape, _SOLID), now.shape, _ELLIPSOID)
        start = _of_shapes(now.fitted, solid)
        doubt = hidden_edges(edges, few, start, solid, now.prior, side, now.factors, now.share)
        hidden = doubt.edges & which[edges.body, None]
        if number == _ROUNDS:
            break
        prior = label_prior(weak, now.prior, best.values, now.covariance, np.where(which, label, -1), now.solid == _CUBOID)
        if sizes:
            prior = known_sizes(prior, now.fitted[_ELLIPSOID], names, sizes)
        now = replace(now, prior=prior)
        if learn and which.any():
            some = with_hidden(edges, hidden).take(few)
            best = replace(best, found=residuals_of_shapes(some, best.values, now.solid))
            some_sides = sides_of(some, points)
            factors = white_factors(some, best.found, some_sides, which[some.body])
            found = share_of(some, best, some_sides, factors, share, which)
            now = replace(now, factors=factors, share=found)
        if bent:
            edges = measure(touched_points(edges, _of_shapes(now.fitted, solid), solid))
    every = np.concatenate([now.evidence, now.others.evidence]), np.concatenate([_axes_of_shapes(now), now.others.axes])
    edges = with_hidden(edges, hidden)
    solid = np.where(now.shape == _POINT, _ELLIPSOID, now.shape)
    unseen = unseen_ends(edges, _of_shapes(now.fitted, solid), solid, now.factors, now.share)
    between = shapes_disagree(*every, now.shape) + doubt.between + unseen
    bodies = _finished(edges, sides_of(edges, points, _counted(edges, now)), now, between)
    others = None if more is None else more(bodies)
    return bodies if others is None else _refitted(edges, others, now, bodies)


def _counted(edges: BoxEdges, now: _State) -> Floats | None:
    """Return which residuals (B, 4) count at the bodies of the last round. Return None before the first round."""
    if now.best is None:
        return None
    return residuals_of_shapes(edges, now.best.values, now.solid).use[:, :4]


def _round(edges: BoxEdges, sides: Sides, now: _State, side: Floats, label: Ints, *, turn: bool) -> _State:
    """Return the state with the best body of each shape, and with the most probable shape of each object.

    turn: whether cuboids are also tried at other headings (`all_headings`).
    """
    weights, first = weights_of(edges, sides.number, now.factors, now.share), now.best is None
    dots, dot_evidence = _dots(edges, now, weights, side)
    ball_prior = sphere_prior(now.prior)
    ball = fit(edges, now.fitted[_SPHERE], ball_prior, weights, ELLIPSOID, still=ENOUGH, most=STEPS)
    rounds = fit(edges, now.fitted[_ELLIPSOID], now.prior, weights, ELLIPSOID, still=ENOUGH, most=STEPS)
    # The first fits of the cuboid and of the cylinder begin at the ellipsoid.
    starts = cuboid_starts(rounds.values) if first else (now.fitted[_CUBOID],)
    square, square_prior = best_cuboids(edges, starts, now.prior, weights, side)
    start = rounds.values if first else now.fitted[_CYLINDER]
    tube = fit(edges, start, now.prior, weights, CYLINDER, still=ENOUGH, most=STEPS)
    round_evidence = log_evidence(edges, rounds, now.prior, weights, side)
    tube_evidence = log_evidence(edges, tube, now.prior, weights, side)
    square_evidence, others = log_evidence(edges, square, square_prior, weights, side), now.others
    if turn:
        rival = np.maximum(round_evidence, tube_evidence)
        square, square_evidence, others = all_headings(edges, square, square_evidence, rival, now.prior, weights, side)
    ball_evidence = log_evidence(edges, ball, ball_prior, weights, side) - np.log(_RARE) - 1e9 * now.sized
    alone = np.stack([dot_evidence, ball_evidence, round_evidence, square_evidence, tube_evidence])
    evidence = with_shares_of_shapes(alone, label)
    others = replace(others, evidence=others.evidence + (evidence - alone)[_CUBOID])
    solid = np.array(_SOLID)[evidence[list(_SOLID)].argmax(axis=0)]
    best = mixed_fit(solid == _CUBOID, edges.body, square, rounds)
    best = mixed_fit(solid == _CYLINDER, edges.body, tube, best)
    return replace(
        now,
        fitted=(dots, ball.values, rounds.values, square.values, tube.values),
        evidence=evidence,
        shape=evidence.argmax(axis=0),
        solid=solid,
        best=best,
        covariance=covariance_of(edges, best, sides, now.factors, now.share),
        others=others,
    )


def _refitted(edges: BoxEdges, others: BoxEdges, now: _State, found: Bodies) -> Bodies:
    """Return the bodies of `edges`. Bodies that also have edges in `others` are fitted once more, to all edges."""
    mine = np.unique(others.body)
    at = np.flatnonzero(np.isin(edges.body, mine))
    both = edges.take(at).joined(others)
    both = replace(both, body=np.searchsorted(mine, both.body))
    start = found.values[mine]
    shape, prior = now.shape[mine], Prior(now.prior.mean[mine], now.prior.information[mine])
    use = residuals_of_shapes(both, start, shape).use[:, :4]
    state = replace(now, prior=prior, fitted=(start,) * len(SHAPES), shape=shape)
    again = _finished(both, sides_of(both, start[:, :3], use), state, found.between_shapes[mine])
    new = {name: getattr(found, name).copy() for name in ("values", "covariance", "unlike", "weight", "to_centre")}
    for name in ("values", "covariance", "unlike"):
        new[name][mine] = getattr(again, name)
    for name in ("weight", "to_centre"):
        new[name][at] = getattr(again, name)[: len(at)]
    return replace(found, **new)


def _finished(edges: BoxEdges, sides: Sides, now: _State, between: Floats) -> Bodies:
    """Return the bodies of the chosen shapes from all boxes. between: (N, 6, 6), see `Bodies.between_shapes`."""
    weights = weights_of(edges, sides.number, now.factors, now.share)
    count, boxes = len(now.shape), len(edges)
    values, (covariance, unlike) = np.zeros((count, 7)), np.zeros((2, count, 7, 7))
    shift, weight = np.zeros((boxes, 2)), np.zeros(boxes)
    for shape in np.unique(now.shape).tolist():
        mine = np.flatnonzero(now.shape == shape)
        at = np.flatnonzero(np.isin(edges.body, mine))
        own = replace(edges.take(at), body=np.searchsorted(mine, edges.body[at]))
        loose = Prior(now.prior.mean[mine], now.prior.information[mine])
        some = Weights(weights.variance[at], weights.spread[at])
        start, kind = now.fitted[max(shape, _SPHERE)][mine], KINDS[shape]
        if shape == _CUBOID:
            loose = cuboid_prior(loose, start)
        tight = sphere_prior(loose) if shape in (_POINT, _SPHERE) else loose
        best = fit(own, start, tight, some, kind, still=ENOUGH)
        if tight is not loose:  # A sphere may really be an ellipsoid, so its covariance is that of an ellipsoid.
            best = fit(own, best.values, loose, some, kind, most=0)
        values[mine] = best.values
        own_sides = sides_of(own, best.values[:, :3])
        covariance[mine], unlike[mine] = covariance_with_unlike(own, best, own_sides, now.factors, now.share)
        shift[at], weight[at] = shifts_of(own, best.found), (best.weight * some.variance)[:, :4].max(axis=1)
    to_centre = np.where((now.shape != _POINT)[edges.body, None], directions_to_centres(edges, values[:, :3], shift), 0.0)
    bound = edges.bound.reshape(boxes, 2, 2).sum(axis=1)
    noise = now.share, now.factors
    return Bodies(values, covariance, now.shape, now.evidence, weight, *noise, to_centre, bound, between, unlike)


def _axes_of_shapes(now: _State) -> Floats:
    """Return centres and half axes (5, N, 6), m, of the bodies of each shape. A point has no half axes."""
    axes = np.stack(
        [np.column_stack([v[:, :3], kind.half_axes(v)]) for v, kind in zip(now.fitted, KINDS, strict=True)],
    )
    axes[_POINT, :, 3:] = np.nan
    return axes


def _of_shapes(fitted: tuple[Floats, ...], shape: Ints) -> Floats:
    """Return the body (N, 7) of the given shape (N,) of each object."""
    return np.stack(fitted)[shape, np.arange(len(shape))]


def _dots(edges: BoxEdges, now: _State, weights: Weights, side: Floats) -> tuple[Floats, Floats]:
    """Return the objects as points (N, 7), and the logarithm (N,) of the evidence of each point.

    Points do not explain the sizes of boxes.
    """
    prior, variance, spread = dot_prior(now.prior), weights.variance.copy(), weights.spread.copy()
    free_rows = ~whole_axes(edges)
    free_rows[:, 2:] = True  # A point does not explain the size of a box.
    variance[:, :4][free_rows] = spread[:, :4][free_rows] = np.inf
    free = replace(weights, variance=variance, spread=spread)
    found = fit(edges, now.fitted[_POINT], prior, free, ELLIPSOID, still=ENOUGH, most=STEPS)
    return found.values, log_evidence(edges, found, prior, weights, side, free=free_rows)
