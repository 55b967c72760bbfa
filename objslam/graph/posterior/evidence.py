"""The evidence for an association: the likelihood of all measurements, over all poses and landmarks (Laplace 1774).

A map can explain more rays, or explain them more closely, if it bends the path. Then the odometry disagrees, and a solve
that estimates the noise finds more noise in the odometry. The evidence counts both: each measurement has a density, which is
lower if its noise is larger. It is integrated over poses and landmarks. So each landmark has a cost, which is larger for a
better determined landmark (Occam factor; MacKay, Information Theory, 2003, chapter 28).
"""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import CAUCHY_K
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.factors.bearing import EQ1_SIGMA
from objslam.graph.posterior.marginals import Solved

_VIEW = 1.0
"""The solid angle (sr) in which a stray ray may lie: about the view of a camera. With a larger value, the number of agreeing
rays counts more, and their noise less."""

_ITERATIONS = 10
"""How often the bias that errors share is computed with new robust weights. Five are usual. More are slower."""


def log_evidence(
    measured: Measurements, association: Association, used: Bools, distance: Floats, solved: Solved, cost: float
) -> float:
    """Return the log evidence for an association, up to a constant that all associations of the same rays share.

    Args:
        measured: the measurements, with the noise at which the graph was solved.
        association: the landmark of each ray.
        used: (R,) the rays in the graph. All others are strays.
        distance: (n,) m, from the origin of each used ray to its landmark.
        solved: the graph at its solution, with its Gaussian noise.
        cost: the cost of the solution, which is half the sum of the squared residuals, with the robust losses.

    Returns:
        The log evidence, -inf if the linear system is indeterminate.
    """
    inverse, rays, settings = solved.inverse, measured.rays, measured.settings
    if inverse is None:
        return -np.inf
    sigma = rays.sigma[used] if settings.joint.factor == "bearing" else EQ1_SIGMA / distance
    total = -cost - float(np.log(2 * np.pi * sigma**2).sum()) - np.log(_VIEW) * int((~used).sum())
    if np.isfinite(rays.range).any():
        total += _of_ranges(measured, association, used, distance)
    if measured.motions is not None:
        _, covariance = measured.odometry()
        total -= float(np.linalg.slogdet(covariance[measured.keyframes.measured])[1].sum()) / 2
    unknowns = len(inverse.scale) - 6 * len(measured.keyframes)  # Those of landmarks. Each has a weak prior.
    return float(total - unknowns * np.log(settings.joint.prior_sigma) - inverse.log_determinant / 2)


def _of_ranges(measured: Measurements, association: Association, used: Bools, distance: Floats) -> float:
    """Return the log density of all ranges, plus their cost in the graph. used, distance: as in `log_evidence`.

    The ranges of a landmark share a bias. In the graph, each range has more noise instead. So the cost in the graph is taken
    out of the evidence, and the log density with the bias takes its place. A stray range has the distribution of all ranges
    of the log.
    """
    rays, ranged = measured.rays, np.isfinite(measured.rays.range)
    spread = float(np.log(12 * np.var(rays.range[ranged]) + 2 * np.pi * np.median(rays.range_sigma[ranged]) ** 2)) / 2
    number = np.bincount(association.object[ranged & (association.object >= 0)], minlength=association.count)
    here = ranged[used]
    some, off = rays.take(np.flatnonzero(used & ranged)), (rays.range[used] - distance)[here]
    owner = association.object[used & ranged]
    variance = some.range_sigma**2 - number[owner] * some.range_bias**2  # Without the noise for the bias.
    density = shared_bias_density(off, variance, some.range_bias**2, owner, association.count)
    in_graph = CAUCHY_K**2 / 2 * float(np.log1p((off / some.range_sigma / CAUCHY_K) ** 2).sum())
    return density + in_graph - spread * (int(ranged.sum()) - len(off))


def shared_bias_density(off: Floats, variance: Floats, bias: Floats, group: Ints, count: int) -> float:
    """Return the log density of errors that share an unknown bias in each group, with Cauchy's loss.

    The bias of a group has its most likely value, with the robust weights of the errors. So one error of many metres, which
    Cauchy's loss allows, does not move it.

    Args:
        off: (n,) m, the errors.
        variance: (n,) m^2, of each error without the bias.
        bias: (n,) m^2, the variance of the bias. The mean of a group counts.
        group: (n,) the group of each error, below `count`.
        count: the number of groups.
    """
    number = np.maximum(np.bincount(group, minlength=count), 1)
    prior = np.bincount(group, bias, count) / number
    weight = 1 / (1 + off**2 / (variance + prior[group]) / CAUCHY_K**2)
    for _ in range(_ITERATIONS):
        wider = 1 + prior * np.bincount(group, weight / variance, count)
        shared = prior * np.bincount(group, weight * off / variance, count) / wider
        weight = 1 / (1 + (off - shared[group]) ** 2 / variance / CAUCHY_K**2)
    squares = CAUCHY_K**2 * np.log1p((off - shared[group]) ** 2 / variance / CAUCHY_K**2).sum()
    some = prior > 0
    squares += (shared[some] ** 2 / prior[some]).sum()
    return -float(squares + np.log(2 * np.pi * variance).sum() + np.log(wider).sum()) / 2
