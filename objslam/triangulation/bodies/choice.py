"""Choose between a point, a sphere, an ellipsoid, a cuboid and a cylinder by their evidence (Laplace; MacKay 1992).

A point explains the place of a box, but not the size of the box. So each size is equally probable for a point. A body
explains both, but a body has more parameters. The wider the priors of its parameters are, the lower is the evidence of the
body (Occam's factor).
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import CAUCHY_K
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import Fit, Prior, Weights

_EQUAL = 1.0
"""The weight of the prior of the shares of shapes, as a number of things of each shape. With a larger number, the other
things of a log say less about the shape of one thing."""
_MOST = 6.0
"""The most things as which the other things of a label count. The same number limits the other things of a log. If the true
shape of things is not among the tried shapes, all have the same error, so a hundred say little more than a few. With a
larger number, the shape of one thing is surer."""
_REPEATS = 20
"""How often `with_shares_of_shapes` repeats its expectation. More repetitions are slower and change little."""


def log_evidence(
    edges: BoxEdges, fit: Fit, prior: Prior, weights: Weights, side: Floats, *, free: Bools | None = None
) -> Floats:
    """Return the logarithm (N,) of the evidence of fitted bodies.

    Boxes from one direction share an error, so together they count as one measurement. side: (B,) px, half the length of the
    image. A measurement that the shape does not explain is uniform over this length. free: (B, 4) a mask of the shifts and
    sizes that a point does not explain, None for other shapes. Other shapes explain all measurements except those whose
    `Residuals.use` is 0.
    """
    now, spread, worth = fit.found, weights.spread[:, :4], np.minimum(weights.spread**2 / weights.variance, 1.0)[:, :4]
    unexplained = now.use[:, :4] == 0 if free is None else free
    squared = np.where(unexplained, 0.0, (now.value[:, :4] / spread) ** 2)
    likelihood = np.where(unexplained, -np.log(side)[:, None], -np.log(spread * np.sqrt(2 * np.pi)))
    lost = CAUCHY_K**2 * np.log1p(squared.sum(axis=1) / 2 / CAUCHY_K**2)  # `fit` also has one Cauchy loss per box.
    each = (worth * likelihood).sum(axis=1) - worth.mean(axis=1) * lost
    off = fit.values - prior.mean
    own = np.bincount(edges.body, each, len(fit.values))
    penalty = 0.5 * np.einsum("ni,nij,nj->n", off, prior.information, off)
    volume = 0.5 * (np.linalg.slogdet(prior.information)[1] - np.linalg.slogdet(fit.information)[1])
    return np.asarray(own - penalty + volume)


def with_shares_of_shapes(evidence: Floats, label: Ints) -> Floats:
    """Return the logarithm (S, N) of the evidence, plus the logarithm of the share of each shape among the other things.

    The boxes of one thing often hardly show whether it is an ellipsoid or a cylinder. But things of one label are alike, and
    so are the things of a room. So a shape gets more probable if other things of the label have it. If few things have the
    label, the shares of the shapes in the whole log count. If the log has few things, equal shares count. The shapes of the
    other things are not known either, so each share is an expectation (CVB0; Asuncion et al. 2009).

    evidence: (S, N) the logarithm of the evidence of each shape. label: (N,) the label of each thing.
    """
    shapes, things = evidence.shape
    own = np.unique(label, return_inverse=True)[1].ravel()
    shares = np.full((shapes, things), 1 / shapes)
    for _ in range(_REPEATS):
        chance = shares * np.exp(evidence - evidence.max(axis=0))
        chance /= chance.sum(axis=0)
        whole = _told(chance.sum(axis=1, keepdims=True) - chance) + _EQUAL
        of_label = np.stack([np.bincount(own, one) for one in chance])[:, own]
        shares = _told(of_label - chance) + _EQUAL * shapes * whole / whole.sum(axis=0)
        shares /= shares.sum(axis=0)
    return np.asarray(evidence + np.log(shares))


def _told(number: Floats) -> Floats:
    """Return numbers (S, N) of things of each shape, scaled down where their sum over the shapes exceeds `_MOST`."""
    return np.asarray(number * np.minimum(1.0, _MOST / np.maximum(number.sum(axis=0), 1e-12)))


def shapes_disagree(evidence: Floats, axes: Floats, chosen: Ints) -> Floats:
    """Return the covariances (N, A, A) that show how much bodies of other shapes, weighted by their evidence, differ from
    the chosen bodies.

    The result is the second moment about the chosen shape. The covariance of a mixture is the sum of this moment and the
    mean covariance of the parts (Hoeting et al. 1999, Bayesian model averaging). evidence: (S, N) the logarithm of the
    evidence of each shape. axes: (S, N, A) centres and half axes, m, of the bodies of each shape, NaN for half axes that a
    shape does not have. chosen: (N,) the index of the chosen shape.
    """
    chance = np.exp(evidence - evidence.max(axis=0))
    chance /= chance.sum(axis=0)
    away = np.nan_to_num(axes - axes[chosen, np.arange(len(chosen))])
    return np.asarray(np.einsum("sn,sna,snb->nab", chance, away, away))
