"""Statistical thresholds that several packages share, errors that last, and medians of groups.

A deviation is a residual divided by its standard deviation, or the norm of several such residuals. The deviation of a ray is
the norm of the two residuals across the ray. The nominal noise of a ray is the standard deviation that the settings give it.
"""

import math
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints

SAME_POINT = 11.345
"""The 99 % quantile of the squared Mahalanobis distance between two estimates of one point (chi-squared, 3 degrees of
freedom). A larger value treats more pairs of estimates as one point."""
SAME_POINT_WIDE = 16.266
"""The 99.9 % quantile of the squared Mahalanobis distance between two estimates of one point (chi-squared, 3 degrees of
freedom). A larger value lets more pairs compete for an assignment."""
POSSIBLE_MOTION = 14.156
"""The 99.73 % quantile of the squared deviation of a planar motion in x, y and yaw (chi-squared, 3 degrees of freedom). This
percentage is the share of a Gaussian within 3 standard deviations. A larger value tries less likely motions."""
STRAY_RAY = 13.816
"""The 99.9 % quantile of the squared deviation of an object's own rays (chi-squared, 2 degrees of freedom). It is also the
cost of a ray that fits no object. A larger deviation gives rays of other things more influence on the solution."""
OUTLIER_RAY = 4.0
"""The deviation above which a ray is rejected. A share of 3e-4 of an object's own rays has a larger deviation (Rayleigh,
exp(-4^2 / 2)). A larger deviation keeps more false boxes."""
CLIPPED_RAY = 6.0
"""The largest deviation with which a ray counts in the measured noise of an object. A ray with a larger deviation counts
with this deviation. With a larger value, a false box increases the measured noise more."""
HALF_RAY = 6.0
"""The squared deviation at which a ray has half of its full weight in a fit of points (Cauchy's weight, about `CAUCHY_K`
squared). A larger deviation gives rays of other things more influence."""
HUBER_K = 1.345
"""The deviation above which Huber's loss grows linearly. This loss is 95 % efficient on Gaussian noise (Huber, Robust
Statistics, 1981). A larger deviation is more efficient and less robust."""
CAUCHY_K = 2.385
"""The deviation that scales Cauchy's loss. This loss is 95 % efficient on Gaussian noise (Holland & Welsch 1977). A larger
deviation is more efficient and less robust."""
RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))
"""The median norm of a standard Gaussian in the plane. It scales the median residual of rays to a standard deviation."""
RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""The mean norm of a standard Gaussian in the plane. It scales the mean residual of rays to a standard deviation."""
NORMAL_MEDIAN = 0.6745
"""The median absolute value of a standard Gaussian. It scales a median absolute deviation to a standard deviation."""
NOISE_FACTORS = (1.0, 3.0)
"""The limits on the factor by which association multiplies the nominal noise of an object's rays. The lower limit is 1,
because a median underestimates the heavy tails of box noise. A larger upper limit accepts rays farther from a noisy
object."""
MOST_NOISE_FACTOR = 5.0
"""The largest factor by which outlier rejection multiplies the nominal noise of an object's rays. It is large because the
box centres of a large object vary. A larger factor keeps more rays of noisy objects."""
NOISE_MEASURED_BY = 6
"""The least number of inliers from which the noise of an object's rays is measured. With fewer inliers, the noise of the
settings counts. A larger number rejects more rays of noisy objects."""
POOLED_WITH_CLASS = 30.0
"""The number of rays at which the measured noise of an object and the noise of its class have equal weight, offline. At the
same number of rays of a class, the noise of the class and the nominal noise have equal weight. A larger number keeps objects
near the noise of their class for longer."""
POOLED_WITH_PROMISE = 20.0
"""The number of rays at which the measured noise of an object and the nominal noise have equal weight, live. A larger number
keeps objects near the nominal noise for longer."""
BETWEEN_VISITS = 5.0
"""The shortest time (s) between two visits to a thing. In a longer time, a moving thing gets farther. With a longer time,
things have fewer visits, so more things are dropped as moving things."""
_LARGE_GROUPS = 100
"""The mean number of values in a group above which a partition of each group is faster than a sort of all values. For
200,000 values in 200 groups, the partition took 2.8 ms and the sort 7.4 ms. A larger number sorts more often."""
_FEW_GROUPS = 1 << 16
"""The most groups whose indices fit into 16 bits. numpy sorts such indices several times as fast."""


@dataclass(frozen=True)
class Lasting:
    """The part of an error that a first-order Gauss-Markov process describes. The rest of the error is white.

    share: the share of the lasting part in the variance, 0 for an error that is independent in each pose, 1 for an error
    without a white part. seconds: the time (s) after which the correlation of the lasting part is 1/e.
    """

    share: float = 0.0
    seconds: float = 0.0

    def like(self, other: "Lasting", tolerance: float) -> bool:
        """Return whether the shares, and the logarithms of the times, each differ by less than a tolerance."""
        if not self.share or not other.share:
            return self.share == other.share
        times = abs(math.log(max(self.seconds, 1e-9) / max(other.seconds, 1e-9)))
        return abs(self.share - other.share) < tolerance and times < tolerance


WHITE = Lasting()
"""An error that is independent in each pose."""


def noise_factors(deviations: Floats, index: Ints, count: int, fewest: int = 1) -> Floats:
    """Return for each group (N,) a factor >= 1 on the nominal noise of rays, from the median of their deviations (R,).

    index: (R,) the group of each ray. count: the number of groups, N. A group of fewer than `fewest` rays has the factor 1.
    """
    number = np.bincount(index, minlength=count)
    median = np.where(number >= fewest, grouped_median(deviations, index, count), 0.0)
    return np.maximum(1.0, median / RAYLEIGH_MEDIAN)


def widening(residual: Floats, index: Ints, count: int) -> Floats:
    """Return the factor (N,) >= 1 on the covariance of each object. The factor is above 1 if rays miss the object by more
    than their noise.

    The factor is the squared ratio of the measured noise to the noise of the settings. residual: (R,) in units of the noise
    of the settings. index, count: as in `noise_factors`.
    """
    return noise_factors(residual, index, count, NOISE_MEASURED_BY) ** 2


def grouped_median(values: Floats, index: Ints, count: int) -> Floats:
    """Return the upper median of the values in each group. A group without values gives NaN.

    index: (R,) the group of each value. count: the number of groups, N. Values (R,) give medians (N,). Values (R, D) give a
    median for each column (N, D).
    """
    if values.ndim == 1:
        return grouped_quantile(values, index, count, 0.5)
    return np.stack([grouped_quantile(column, index, count, 0.5) for column in values.T], axis=1)


def grouped_quantile(values: Floats, index: Ints, count: int, share: float) -> Floats:
    """Return for each group (N,) the value at a share (0 to 1) of its sorted values (R,). A group without values gives NaN.

    index: (R,) the group of each value. count: the number of groups, N.
    """
    return grouped_quantiles(values, index, count, (share,))[0]


def grouped_quantiles(values: Floats, index: Ints, count: int, shares: tuple[float, ...]) -> list[Floats]:
    """Return the result of `grouped_quantile` for each share."""
    number = np.bincount(index, minlength=count)
    some = number > 0
    begin, number = (np.cumsum(number) - number)[some], number[some]
    places = [np.minimum((share * number).astype(np.int64), number - 1) for share in shares]
    if len(index) > _LARGE_GROUPS * len(begin):
        ordered = values[order_by_group(index, count)]
        for first, size, *wanted in zip(begin.tolist(), number.tolist(), *(place.tolist() for place in places), strict=True):
            ordered[first : first + size].partition(wanted)
    else:
        order = np.argsort(values)  # Two sorts are several times as fast as np.lexsort.
        ordered = values[order[order_by_group(index[order], count)]]
    results = [np.full(count, np.nan) for _ in shares]
    for place, result in zip(places, results, strict=True):
        result[some] = ordered[begin + place]
    return results


def grouped_sums(values: Floats, index: Ints, count: int) -> Floats:
    """Return the sums (count, D) of the values (P, D) of each group. index: (P,) the group of each row."""
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1).astype(np.float64)


def grouped_visits(stamps: Floats, index: Ints, away: float) -> Ints:
    """Return the visit (R,) of each ray: rays of one object without a gap of more than `away` seconds between them.

    Visits of one object have consecutive numbers, and no visit has rays of two objects. stamps: (R,) s. index: (R,) the
    object of each ray."""
    order = np.lexsort((stamps, index))
    begins = np.append(False, (np.diff(index[order]) != 0) | (np.diff(stamps[order]) > away))[: len(index)]
    visit = np.zeros(len(index), dtype=np.int64)
    visit[order] = np.cumsum(begins)
    return visit


def order_by_group(index: Ints, count: int) -> Ints:
    """Return the order (R,) that brings the members of each group together. Members of one group keep their order.

    index: (R,) the group of each member, from 0 to count - 1.
    """
    return np.argsort(index.astype(np.uint16) if count <= _FEW_GROUPS else index, kind="stable")


def distinct(values: Ints) -> Ints:
    """Return the different values (D,) among many integers (R,), ascending.

    `np.unique` returns the same. It puts the values into a hash table, which takes up to 80 times as long as a sort.
    """
    ordered = np.sort(values)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])] if len(ordered) else ordered


def quantile(values: Floats, share: float) -> float:
    """Return the value at a share (0 to 1) of the sorted values (R,), interpolated between two neighbours. R is at least 1.

    `np.quantile` returns the same. For some tens of values it takes ten times as long, and a session needs it at each
    keyframe.
    """
    ordered, at = np.sort(values), share * (len(values) - 1)
    below = int(at)
    low, high = ordered[below], ordered[min(below + 1, len(values) - 1)]
    return float(low + (at - below) * (high - low))


_FEW = 20_000
"""The most numbers for which special functions are computed without scipy.special. Its import takes 0.06 s, about as long as
the association of a small log. The computation without it takes 0.02 s for this many numbers."""
_DEVIATIONS = 9.0
"""The number of standard deviations above the mean up to which a Poisson tail is summed. For small means, the square of this
number is added to the limit. The rest is below 1e-16 of the tail. A larger number makes the sum longer."""


def logistic(odds: Floats) -> Floats:
    """Return the probabilities (N,) of log odds (N,): 1 / (1 + exp(-odds)), without overflow.

    `scipy.special.expit` returns the same, but its import takes 0.04 s.
    """
    return np.asarray(np.exp(-np.logaddexp(0.0, -odds)))


def poisson_tail(least: Ints, mean: Floats) -> Floats:
    """Return the probability (...) that a Poisson variable of this mean (...) is at least `least` (...).

    The tail is the regularised incomplete gamma function (NIST DLMF 8.4.10). For few numbers, the probabilities of all
    counts are summed instead. scipy.stats has this function, but its import takes 0.3 s.
    """
    count, mean = np.maximum(least, 1).ravel().astype(np.float64), mean.ravel()
    beyond = np.maximum(mean - count, 0.0) + _DEVIATIONS * np.sqrt(np.maximum(mean, count)) + _DEVIATIONS**2
    terms = math.ceil(float(beyond.max(initial=0.0)))
    if terms * len(count) <= _FEW:
        # Logarithms are used, because for a large mean the first term would be 0, and ratios would overflow.
        with np.errstate(divide="ignore", under="ignore"):
            logs = np.empty((len(count), max(terms, 1)))
            logs[:, 0] = count * np.log(mean) - mean - _log_gamma(count + 1)
            logs[:, 1:] = np.log(mean)[:, None] - np.log(count[:, None] + np.arange(1, terms))
            tail = np.minimum(np.exp(np.cumsum(logs, axis=1)).sum(axis=1), 1.0)
    else:
        from scipy.special import gammainc

        tail = gammainc(count, mean)
    return np.where(least > 0, tail.reshape(least.shape), 1.0)


def binomial_tail(least: Ints, number: Ints, share: float) -> Floats:
    """Return the probability (...) that at least `least` (...) of `number` (...) tries succeed. share: between 0 and 1, the
    probability of a success.

    It is the regularised incomplete beta function (NIST DLMF 8.17.24). For few numbers, the probabilities of all counts are
    summed instead.
    """
    least, number = (np.asarray(of).astype(np.int64) for of in np.broadcast_arrays(least, number))
    most = int(number.max(initial=0)) + 1
    if most * number.size <= _FEW:
        factorials = np.append(0.0, np.cumsum(np.log(np.arange(1.0, most))))  # The logarithms of the factorials.
        count = np.arange(most)
        left = number[..., None] - count
        logs = factorials[np.maximum(number, 0)][..., None] - factorials - factorials[np.maximum(left, 0)]
        logs += count * np.log(share) + left * np.log1p(-share)
        some = (count >= least[..., None]) & (left >= 0)
        return np.asarray(np.minimum(np.exp(np.where(some, logs, -np.inf)).sum(axis=-1), 1.0))
    from scipy.special import betainc

    some, all_ = (least > 0) & (least <= number), least <= 0
    return np.where(some, betainc(np.maximum(least, 1), np.maximum(number - least, 0) + 1, share), all_.astype(np.float64))


def log_beta(a: Floats, b: Floats) -> Floats:
    """Return the logarithms (...) of the beta function of positive numbers (...)."""
    if a.size <= _FEW:
        return _log_gamma(a) + _log_gamma(b) - _log_gamma(a + b)
    from scipy.special import betaln

    return np.asarray(betaln(a, b))


def _log_gamma(values: Floats) -> Floats:
    """Return the logarithms (...) of the gamma function of a few positive numbers (...)."""
    return np.array([math.lgamma(value) for value in values.ravel().tolist()]).reshape(values.shape)
