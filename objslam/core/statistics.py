"""The numbers of statistics that several parts ask, each in its one home, and medians of groups.

Deviations are in standard deviations. A ray's is the norm of two, one along each axis across it.
"""

from __future__ import annotations

import math

import numpy as np

from objslam.core.arrays import Floats, Ints

SAME_POINT = 11.345
"""The squared Mahalanobis distance below which 99 % of the pairs of estimates of one point in space lie (chi-squared, 3
degrees of freedom); larger takes more pairs for one point."""
SAME_POINT_WIDE = 16.266
"""The squared Mahalanobis distance below which 99.9 % of the pairs of estimates of one point in space lie (chi-squared, 3
degrees of freedom); larger lets more pairs compete."""
POSSIBLE_MOTION = 14.156
"""The squared deviation below which 99.73 % of planar motions lie (chi-squared, 3 degrees of freedom, x, y and yaw: as many
as lie within 3 standard deviations of one number); larger tries motions that are less likely."""
STRAY_RAY = 13.816
"""The squared deviation below which 99.9 % of an object's own rays lie (chi-squared, 2 degrees of freedom), and what a ray
that fits nothing costs; larger makes a stray ray pull harder on the solution."""
OUTLIER_RAY = 4.0
"""The deviation above which a ray is rejected, as 3e-4 of an object's own rays are (Rayleigh, exp(-4^2 / 2)); larger keeps
more false boxes."""
CLIPPED_RAY = 6.0
"""The most that the deviation of one ray counts in an object's own noise; larger lets a false box make it noisier."""
HALF_RAY = 6.0
"""The squared deviation at which a ray counts half in a fit of points (Cauchy's weight, about `CAUCHY_K` squared); larger
lets stray rays pull harder."""

HUBER_K = 1.345
"""The deviation from which Huber's loss grows linearly: 95 % efficient on Gaussian noise (Huber, Robust Statistics, 1981);
larger is more efficient and less robust."""
CAUCHY_K = 2.385
"""The scale of Cauchy's loss, in deviations: 95 % efficient on Gaussian noise (Holland & Welsch 1977); larger is more
efficient and less robust."""

RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))
"""The median norm of a standard Gaussian in the plane: the median miss of rays divided by it is their standard deviation."""
RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""The mean norm of a standard Gaussian in the plane: the mean miss of rays divided by it is their standard deviation."""
NORMAL_MEDIAN = 0.6745
"""The median absolute value of a standard Gaussian: a median absolute deviation divided by it is the standard deviation."""

NOISE_FACTORS = (1.0, 3.0)
"""The least and the most factor on the promised noise of an object's rays where boxes are associated: never below 1, for the
tails of box noise are heavy; a larger most gives noisy objects rays that are farther off."""
MOST_NOISE_FACTOR = 5.0
"""The most factor on the promised noise of an object's rays where outliers are rejected (the box centres of a large object
wander); larger keeps more rays of noisy objects."""
POOLED_WITH_CLASS = 30.0
"""The number of rays with which an object's own noise weighs as much as that of its class, where a log is associated as a
whole; larger trusts the class for longer."""
POOLED_WITH_PROMISE = 20.0
"""The number of rays with which an object's own noise weighs as much as the promised one, in a session; larger trusts the
promise for longer."""


def noise_factors(deviations: Floats, index: Ints, count: int, fewest: int = 1) -> Floats:
    """Factors (N,) >= 1 on the promised noise of the rays of each group, by the median of their deviations (R,).

    index: (R,) group of each ray. A group of fewer rays than `fewest` is as promised.
    """
    number = np.bincount(index, minlength=count)
    median = np.where(number >= fewest, grouped_median(deviations, index, count), 0.0)
    return np.maximum(1.0, median / RAYLEIGH_MEDIAN)


def grouped_median(values: Floats, index: Ints, count: int) -> Floats:
    """The upper median of the values in each group; NaN for a group without values.

    index: (R,) the group of each value. Values (R,) give medians (N,). Values (R, D) give the medians of each column (N, D).
    """
    if values.ndim == 1:
        return grouped_quantile(values, index, count, 0.5)
    return np.stack([grouped_quantile(column, index, count, 0.5) for column in values.T], axis=1)


def grouped_quantile(values: Floats, index: Ints, count: int, share: float) -> Floats:
    """The value (N,) of each group with `share` of its values below; NaN where there is none."""
    return grouped_quantiles(values, index, count, (share,))[0]


def grouped_quantiles(values: Floats, index: Ints, count: int, shares: tuple[float, ...]) -> list[Floats]:
    """The same for each of several shares."""
    order = np.lexsort((values, index))
    number = np.bincount(index, minlength=count)
    begin, some = np.cumsum(number) - number, number > 0
    results = [np.full(count, np.nan) for _ in shares]
    for share, result in zip(shares, results, strict=True):
        at = begin + np.minimum((share * number).astype(np.int64), np.maximum(number - 1, 0))
        result[some] = values[order[at[some]]]
    return results
