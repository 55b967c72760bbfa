"""The evidence for an association: the likelihood of all measurements, over all poses and landmarks (Laplace 1774).

A map can explain more rays, or explain them more closely, if it bends the path. Then the odometry disagrees, and a solve
that estimates the noise finds more noise in the odometry. The evidence counts both: each measurement has a density, which is
lower if its noise is larger. The product of the densities is integrated over poses and landmarks. So each landmark has a
cost, which is larger for a better determined landmark (Occam factor; MacKay, Information Theory, 2003, chapter 28).

The ranges of one visit to a thing err alike, because they end on the same part of the thing, or on what stands before it. If
each range counted for itself, a map with the thing at another place for each visit would have more evidence.
"""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import CAUCHY_K, NORMAL_MEDIAN, grouped_median, grouped_visits
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.factors.bearing import EQ1_SIGMA
from objslam.graph.posterior.marginals import Solved

_VIEW = 1.0
"""The solid angle (sr) in which a stray ray may lie: about the view of a camera. With a larger value, the number of agreeing
rays counts more, and their noise less."""

_ITERATIONS = 10
"""The number of times that the bias that errors share is computed with new robust weights. Five are usual. A larger number
is slower."""

_AWAY = 3.0
"""The shortest time (s) without a box of a thing that separates two visits to it. With a longer time, more ranges share an
error."""

_FEWEST = 3
"""The least number of ranges of a visit that show the noise of single ranges. Of only two ranges, one is the median."""

_PRIOR_VISITS = 2
"""The weight of the bias in the settings, as a number of visits, in the estimate of the bias of each label. With a larger
number, labels differ less."""


def log_evidence(
    measured: Measurements,
    association: Association,
    used: Bools,
    distance: Floats,
    solved: Solved,
    cost: float,
    ranges_open: bool = False,
) -> float:
    """Return the log evidence for an association, up to a constant that all associations of the same rays share.

    Args:
        measured: the measurements, with the noise at which the graph was solved.
        association: the landmark of each ray.
        used: (R,) the rays in the graph. All others are strays.
        distance: (n,) m, from the origin of each used ray to its landmark.
        solved: the graph at its solution, with its Gaussian noise.
        cost: the cost of the solution, which is half the sum of the squared residuals, with the robust losses.
        ranges_open: whether the noise of ranges is estimated. If so, the density of ranges has the noise that the
            association shows, and each visit has its own bias. If not, the ranges of a landmark share the bias of the
            settings.

    Returns:
        The log evidence, -inf if the linear system is indeterminate.
    """
    inverse, rays, settings = solved.inverse, measured.rays, measured.settings
    if inverse is None:
        return -np.inf
    sigma = rays.sigma[used] if settings.joint.factor == "bearing" else EQ1_SIGMA / distance
    total = -cost - float(np.log(2 * np.pi * sigma**2).sum()) - np.log(_VIEW) * int((~used).sum())
    if np.isfinite(rays.range).any():
        total += _of_ranges(measured, association, used, distance, ranges_open)
    if measured.motions is not None:
        _, covariance = measured.odometry()
        total -= float(np.linalg.slogdet(covariance[measured.keyframes.measured])[1].sum()) / 2
    unknowns = len(inverse.scale) - 6 * len(measured.keyframes)  # Those of landmarks. Each has a weak prior.
    return float(total - unknowns * np.log(settings.joint.prior_sigma) - inverse.log_determinant / 2)


def _of_ranges(measured: Measurements, association: Association, used: Bools, distance: Floats, noise_open: bool) -> float:
    """Return the log density of all ranges, plus their cost in the graph. used, distance: as in `log_evidence`.

    The ranges of a visit, or of a landmark, share a bias. In the graph, each range has more noise instead. So the cost in
    the graph is taken out of the evidence, and the log density with the bias takes its place. A stray range has the
    distribution of all ranges of the log. noise_open: `ranges_open` of `log_evidence`.
    """
    rays, ranged = measured.rays, np.isfinite(measured.rays.range)
    spread = float(np.log(12 * np.var(rays.range[ranged]) + 2 * np.pi * np.median(rays.range_sigma[ranged]) ** 2)) / 2
    number = np.bincount(association.object[ranged & (association.object >= 0)], minlength=association.count)
    here = ranged[used]
    some, off = rays.take(np.flatnonzero(used & ranged)), (rays.range[used] - distance)[here]
    owner = association.object[used & ranged]
    variance = some.range_sigma**2 - number[owner] * some.range_bias**2  # Without the noise for the bias.
    bias, group = some.range_bias**2, owner
    if noise_open:
        group = grouped_visits(measured.keyframes.stamps[some.keyframe], owner, _AWAY)
        label = association.label[owner]
        variance, bias = _noise_of_visits(off, variance, bias, group, label, measured.settings.noise.prior)
    density = shared_bias_density(off, variance, bias, group, int(group.max(initial=-1)) + 1)
    in_graph = CAUCHY_K**2 / 2 * float(np.log1p((off / some.range_sigma / CAUCHY_K) ** 2).sum())
    return density + in_graph - spread * (int(ranged.sum()) - len(off))


def _noise_of_visits(
    off: Floats, variance: Floats, bias: Floats, visit: Ints, label: Ints, prior: float
) -> tuple[Floats, Floats]:
    """Return two variances (n,) m^2 for each range: of the range without the bias, and of the bias of its visit.

    The errors `off` determine both variances. Each label has a factor on its variance, and one bias, because a camera sees
    through the things of some labels, or past them. off, variance, bias: as in `shared_bias_density`, with the noise of the
    solve. label: (n,). prior: the weight of the noise of the solve, as a number of ranges.
    """
    visits, labels = int(visit.max(initial=-1)) + 1, int(label.max(initial=-1)) + 1
    number, middle = np.bincount(visit, minlength=visits), grouped_median(off, visit, visits)
    many = number[visit] >= _FEWEST
    deviation = np.abs(off - middle[visit])[many] / np.sqrt(variance[many])
    factor = np.nan_to_num(grouped_median(deviation, label[many], labels)) / NORMAL_MEDIAN
    ranges = np.bincount(label[many], minlength=labels)
    variance = variance * ((prior + ranges * factor**2) / (prior + ranges))[label]
    first = np.unique(visit, return_index=True)[1]  # The ranges of a visit have one label.
    of, squares = label[first], np.maximum(middle**2 - variance[first] / number, 0.0)
    each = np.bincount(of, minlength=labels)
    nominal = np.bincount(label, bias, labels) / np.maximum(np.bincount(label, minlength=labels), 1)
    shared = (_PRIOR_VISITS * nominal + np.bincount(of, squares, labels)) / (_PRIOR_VISITS + each)
    return variance, shared[label]


def shared_bias_density(off: Floats, variance: Floats, bias: Floats, group: Ints, count: int) -> float:
    """Return the log density of errors that share an unknown bias in each group, with Cauchy's loss.

    The bias of a group has its most likely value, with the robust weights of the errors. So one error of many metres, which
    Cauchy's loss allows, does not move it.

    Args:
        off: (n,) m, the errors.
        variance: (n,) m^2, of each error without the bias.
        bias: (n,) m^2, the variance of the bias. Each group uses the mean of its values.
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
