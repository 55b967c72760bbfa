"""The choice between a point, a sphere, an ellipsoid and a cuboid by their evidence (Laplace's method; MacKay 1992).

A point explains where a box is, and takes each of its sides as any length in the image. A body explains both. It has more
parameters, whose prior volume counts against it.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.statistics import CAUCHY_K
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import Fit, Prior, Weights


def log_evidence(edges: BoxEdges, fit: Fit, prior: Prior, weights: Weights, *, free_side: Floats | None = None) -> Floats:
    """Return the logarithm of the evidence (N,) of a fit.

    free_side: (B,) px, for points, half the length of the image, within which half a side of a box may lie. None if the
    shape explains the sides. Boxes from one side repeat one error, so a box counts with its share of one measurement.
    """
    now, spread, worth = fit.found, weights.spread[:, :4], np.minimum(weights.spread**2 / weights.variance, 1.0)[:, :4]
    squared = now.use[:, :4] * (now.value[:, :4] / spread) ** 2
    likelihood = -np.log(spread * np.sqrt(2 * np.pi))
    if free_side is not None:
        squared[:, 2:], likelihood[:, 2:] = 0.0, -np.log(free_side)[:, None]
    lost = CAUCHY_K**2 * np.log1p(squared.sum(axis=1) / 2 / CAUCHY_K**2)  # The loss of `fit`, for a box as a whole.
    each = (worth * now.use[:, :4] * likelihood).sum(axis=1) - worth.mean(axis=1) * lost
    off = fit.values - prior.mean
    own = np.bincount(edges.body, each, len(fit.values))
    penalty = 0.5 * np.einsum("ni,nij,nj->n", off, prior.information, off)
    volume = 0.5 * (np.linalg.slogdet(prior.information)[1] - np.linalg.slogdet(fit.information)[1])
    return np.asarray(own - penalty + volume)
