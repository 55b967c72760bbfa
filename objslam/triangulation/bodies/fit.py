"""Fit bodies to the boxes of objects by robust, damped Gauss-Newton steps for all objects at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import CAUCHY_K
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.residuals import ROWS, Residuals, residuals
from objslam.triangulation.bodies.shapes import PARAMETERS, Kind

_ITERATIONS = 40
"""The most steps of a fit. Usually a fit takes ten. More steps are slower."""
STILL = 1e-9
"""The predicted decrease of the cost in a step below which the fit of a body ends. The cost is half the sum of squared
deviations. A larger value ends the fit sooner."""
ENOUGH = 1e-3
"""The limit that replaces `STILL` in a fit that only chooses a shape. A larger value ends the fit sooner."""
STEPS = 12
"""The most steps of a fit that chooses a shape. A fit of the right shape needs fewer. More steps are slower."""
_UPHILL = 1e-3
"""The share by which a step may raise the cost. The derivatives ignore changes of the distance to a body, so steps near the
optimum may raise the cost slightly. A larger share accepts worse steps."""
_DAMPING = (1e-3, 1e-9, 1e6)
"""The first, the least and the most damping of steps, as shares of the curvature. More damping makes shorter steps."""
_LONGEST = 0.7
"""The longest step of a parameter that is a logarithm or an angle (rad). A longer step may leave the region in which the
linear model holds."""
_REMAIN = 0.7
"""The share of unfinished bodies below which their data are copied, so that only they get more steps. With a
larger share, data are copied more often."""
_MANY = 20
"""The mean number of boxes of a body from which on one matrix product for each body is used. With fewer boxes, a small
product for each box is faster (measured). Both give the same sums. With a larger number, small products are used more
often."""


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior on the parameters of N bodies.

    mean: (N, 7). information: (N, 7, 7), the inverse of the covariance.
    """

    mean: Floats
    information: Floats


@dataclass(frozen=True)
class Weights:
    """How much the residuals of boxes count.

    spread: (B, 5) the standard deviation of each residual. variance: (B, 5) the variance with which a residual counts. It is
    larger than spread^2 if residuals share an error, so that many residuals count as few. robust: whether residuals far
    beyond their spread count less (Cauchy's weight).
    """

    variance: Floats
    spread: Floats
    robust: bool = True


@dataclass(frozen=True)
class Fit:
    """The best bodies of N objects with B boxes.

    values: (N, 7) the parameters. found: the residuals of the boxes. weight: (B, 5) the weight of each residual, 1 /
    variance. information: (N, 7, 7) from boxes and prior. prior: (N, 7, 7) the information of the prior alone.
    """

    values: Floats
    weight: Floats
    found: Residuals
    information: Floats
    prior: Floats


def fit(
    edges: BoxEdges,
    start: Floats,
    prior: Prior,
    weights: Weights,
    kind: Kind,
    *,
    still: float = STILL,
    most: int = _ITERATIONS,
) -> Fit:
    """Return the most probable bodies of one kind.

    start: (N, 7) the parameters at which the fit starts. still: see `STILL`. most: the most steps.
    """
    values, now = start.copy(), residuals(edges, start, kind)
    moving = np.arange(len(start))
    damping = np.full(len(start), _DAMPING[0])
    steps = 0
    while len(moving) and steps < most:
        part, some, own, mine, before = moving, edges, prior, weights, now
        if len(part) < len(start):
            boxes = np.flatnonzero(np.isin(edges.body, part))
            some, before = edges.take(boxes), now.take(boxes)
            some = replace(some, body=np.searchsorted(part, some.body))
            mine = Weights(weights.variance[boxes], weights.spread[boxes], weights.robust)
            own = Prior(prior.mean[part], prior.information[part])
        values[part], damping[part], found, rest, steps = _steps(
            some, values[part], damping[part], before, own, mine, kind, (steps, most, still)
        )
        if some is edges:
            now = found
        else:
            now.put(boxes, found)
        moving = part[~rest]
    weight = _weight(now, weights)
    information, _, _ = _normal(edges.body, now, weight, prior, values)
    return Fit(values, weight * now.use, now, information, prior.information)


def _steps(
    edges: BoxEdges,
    values: Floats,
    damping: Floats,
    now: Residuals,
    prior: Prior,
    weights: Weights,
    kind: Kind,
    limits: tuple[int, int, float],
) -> tuple[Floats, Floats, Residuals, Bools, int]:
    """Take steps until few bodies are unfinished.

    Return the bodies (N, 7), the dampings (N,), the residuals, a mask (N,) of finished bodies, and the number of steps so
    far. now: the residuals before. limits: the number of steps so far, the most steps, and the value for `STILL`.
    """
    steps, most, enough = limits
    still = np.zeros(len(values), dtype=bool)
    while steps < most and (~still).mean() > _REMAIN:
        steps += 1
        weight = _weight(now, weights)
        information, gradient, cost = _normal(edges.body, now, weight, prior, values)
        damped = information + (damping[:, None] * np.einsum("nii->ni", information))[..., None] * np.eye(PARAMETERS)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        longest = np.abs(step[:, 3:]).max(axis=1)
        step *= np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-12))[:, None]
        promised = -(step * gradient).sum(axis=1)
        trial = values + step
        new = residuals(edges, trial, kind)
        better = _cost(edges.body, new, weight, prior, trial) <= cost * (1 + _UPHILL) + enough
        values = np.where(better[:, None], trial, values)
        now = new if better.all() else _chosen(better[edges.body], new, now)
        still |= (promised < enough) | (damping >= _DAMPING[2])
        damping = np.clip(np.where(better, damping / 10, damping * 10), *_DAMPING[1:])
    return values, damping, now, still, steps


def _chosen(which: Bools, new: Residuals, old: Residuals) -> Residuals:
    return Residuals(np.where(which[:, None, None], new.rows, old.rows), np.where(which[:, None], new.use, old.use))


def grouped(group: Ints, rows: Floats, count: int) -> Floats:
    """Return the sums (count, ...) of the rows (B, ...) of each group.

    group: (B,) the group of each row. The sums are the fastest if the groups are in order.
    """
    total = np.zeros((count, *rows.shape[1:]))
    if not len(group):
        return total
    if (np.diff(group) < 0).any():
        order = np.argsort(group, kind="stable")
        group, rows = group[order], rows[order]
    begin = np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1])
    total[group[begin]] = np.add.reduceat(rows, begin, axis=0)
    return total


def _weight(now: Residuals, weights: Weights) -> Floats:
    weight = 1 / weights.variance
    weight[:, -1] *= now.use[:, -1]  # A range whose ray begins to hit the body within a step does not count yet.
    if not weights.robust:
        return weight
    squared = now.use * (now.value / weights.spread) ** 2
    # If a box shows another thing, all its edges are wrong. So the four residuals of its edges get one weight.
    squared[:, : ROWS - 1] = squared[:, : ROWS - 1].sum(axis=1, keepdims=True) / 2
    return np.asarray(weight / (1 + squared / CAUCHY_K**2))


def _normal(body: Ints, now: Residuals, weight: Floats, prior: Prior, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the information (N, 7, 7), the gradient (N, 7) and the cost (N,) of the bodies."""
    rooted = np.empty(now.rows.shape)  # The numbers of a box are contiguous in memory, because the sums run over boxes.
    np.multiply(now.rows, np.sqrt(weight * now.use)[..., None], out=rooted)
    sums = sums_of_products(body, rooted[..., :PARAMETERS], rooted, len(values))
    information = sums[:, :, :PARAMETERS] + prior.information
    gradient = sums[:, :, PARAMETERS] + np.einsum("nij,nj->ni", prior.information, values - prior.mean)
    return information, gradient, _cost(body, now, weight, prior, values)


def sums_of_products(body: Ints, one: Floats, other: Floats, count: int) -> Floats:
    """Return the sums (N, D, E) of the products one^T other over the boxes of each body. one: (B, R, D). other: (B, R, E).

    body: (B,) the body of each box. count: the number N of bodies.
    """
    if len(body) < _MANY * count or (np.diff(body) < 0).any():
        return grouped(body, np.swapaxes(one, 1, 2) @ other, count)
    ends = (one.shape[1] * np.searchsorted(body, np.arange(count + 1))).tolist()
    wide, deep = one.reshape(-1, one.shape[2]).T, other.reshape(-1, other.shape[2])
    total = np.empty((count, len(wide), deep.shape[1]))
    for mine, (first, last) in zip(total, pairwise(ends), strict=True):
        np.matmul(wide[:, first:last], deep[first:last], out=mine)
    return total


def _cost(body: Ints, now: Residuals, weight: Floats, prior: Prior, values: Floats) -> Floats:
    """Return the cost (N,) of each body: half the weighted sum of squares of its residuals and of its prior.

    weight: (B, 5), kept fixed during a step, with its robust part. now: the residuals at `values`. An edge that is a bound
    counts only while the body does not reach beyond it. `now.use` says this for `values`. So the cost of a step shows at
    once that the body has crossed a bound, and the steps do not jump back and forth across the bound.
    """
    off = values - prior.mean
    own = np.bincount(body, (weight * now.use * now.value**2).sum(axis=1), len(values))
    return np.asarray(0.5 * own + 0.5 * np.einsum("ni,nij,nj->n", off, prior.information, off))
