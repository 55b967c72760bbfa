"""Estimate the noise of ranges from their residuals, for all labels together and for each label.

Some ranges of a thing that a camera can see past, such as a table, end behind the thing. So the ranges of some labels are
worse than those of others.
"""

import math
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import HUBER_K, NORMAL_MEDIAN, grouped_median

_PRIOR_OBJECTS = 4
"""The largest weight of the range bias in the settings, as a number of objects. With a larger number, the bias changes
less."""
_LABEL_OBJECTS = 2
"""The weight of the bias of all labels in the bias of one label, as a number of objects. With a larger number, labels differ
less."""
_BEYOND = math.erfc(HUBER_K / math.sqrt(2))
"""The share of Gaussian numbers beyond `HUBER_K` standard deviations. `scipy.stats` has the function for this, but its
import takes half a second."""
_HUBER_SHARE = 1 - _BEYOND - 2 * HUBER_K * math.exp(-(HUBER_K**2) / 2) / math.sqrt(2 * math.pi) + HUBER_K**2 * _BEYOND
"""The mean of min(z^2, `HUBER_K`^2) for Gaussian numbers z with the standard deviation 1."""
_ROUNDS = 30  # The most rounds of Huber's proposal 2. It converges in a few rounds. A larger number takes longer.


@dataclass(frozen=True)
class RangeNoise:
    """The nominal noise of q ranges to N landmarks.

    owner: (q,) the landmark of each range. label: (q,) the label of the box of each range. landmark_label: (N,). sigma: (q,)
    m, the standard deviation of a single range. bias: (q,) m, that of the error that the ranges of an object share.
    """

    owner: Ints
    label: Ints
    landmark_label: Ints
    sigma: Floats
    bias: Floats

    def total(self, factors: Floats) -> Floats:
        """Return the noise (q,), m, of ranges, with their part of the object's bias, as in `factors.range.share_bias`.

        factors: (2, L) the factors on `sigma` and on `bias` for each label.
        """
        ranges, bias = factors[:, self.label]
        number = np.bincount(self.owner)[self.owner] if len(self.owner) else np.zeros(0)
        return np.sqrt((self.sigma * ranges) ** 2 + number * (self.bias * bias) ** 2)

    def estimate(self, off: Floats, labels: int, prior: float) -> tuple[float, float, Floats]:
        """Return the factors on the noise of single ranges and on their bias, and both factors (2, L) for each label.

        The factors of a label are NaN if it has fewer than two objects with a bias. One object tells nothing about its
        label, because its rays may be those of two things, or its place may be wrong. off: (q,) m, the residuals. labels:
        the number L of labels. prior: the weight of the nominal noise, as a number of residuals.
        """
        count, label = len(self.landmark_label), self.landmark_label
        number = np.bincount(self.owner, minlength=count)
        middle = np.nan_to_num(grouped_median(off, self.owner, count))
        deviation = np.abs(off - middle[self.owner]) / self.sigma
        free = max(len(off) - int((number > 0).sum()), 0)
        ranges = float(np.sqrt((prior + free * (np.median(deviation) / NORMAL_MEDIAN) ** 2) / (prior + free)))
        bias = np.nan_to_num(grouped_median(self.bias, self.owner, count))
        has = np.flatnonzero((number > 1) & (bias > 0))
        if not len(has):
            return ranges, 1.0, np.full((2, labels), np.nan)
        objects = np.bincount(label[number > 0], minlength=labels)
        within = np.nan_to_num(grouped_median(deviation, self.label, labels)) / NORMAL_MEDIAN
        free_of = np.maximum(np.bincount(self.label, minlength=labels) - objects, 0)
        own = np.sqrt((prior * ranges**2 + free_of * within**2) / (prior + free_of))
        many = np.bincount(label[has], minlength=labels)
        own = np.where(many > 1, own, ranges)
        typical = np.sqrt(grouped_median(self.sigma**2, self.owner, count)[has]) * own[label[has]]
        squares = (middle[has] ** 2 - typical**2 / number[has]) / bias[has] ** 2
        # If no label has two objects, nothing tells bad labels from bad places. Then both count as noise.
        limit = HUBER_K**2 if many.max() > 1 else np.inf
        shared = _robust_variance(squares, min(prior, float(_PRIOR_OBJECTS)), limit)
        total = np.maximum(np.bincount(label[has], squares, labels), 0.0)
        each = np.sqrt((_LABEL_OBJECTS * shared + total) / (_LABEL_OBJECTS + many))
        return ranges, float(np.sqrt(shared)), np.where(many > 1, [own, each], np.nan)


def _robust_variance(squares: Floats, weight: float, limit: float) -> float:
    """Return the variance from squares (n,) by Huber's proposal 2 (Huber 1964), with a prior variance of 1.

    weight: the weight of the prior, as a number of squares. limit: the number of variances up to which a square counts. With
    inf, the result is the weighted mean.
    """
    variance, share = 1.0, _HUBER_SHARE if np.isfinite(limit) else 1.0
    for _ in range(_ROUNDS):
        limited = max(float(np.minimum(squares, limit * variance).sum()), 0.0) / share
        before, variance = variance, (weight + limited) / (weight + len(squares))
        if abs(variance - before) < 1e-6 * before:
            break
    return variance
