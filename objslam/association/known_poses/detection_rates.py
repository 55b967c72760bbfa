"""Estimate how often the objects of each class are detected where they should be."""

from dataclasses import dataclass

import numpy as np

from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Floats, Ints

_PHANTOM_SHARE = 1 / 8  # The detection rate of a phantom landmark, as a share of the rate of its class.
_CONCENTRATIONS = (3.0, 5.0, 8.0, 13.0, 21.0, 34.0, 55.0)  # The tried concentrations. Larger values mean similar rates.
_CLEAR_LEAD = 5.0  # A concentration this far below the best, in ln likelihood, is excluded. A larger lead drops fewer.
_POOLED_BOXES = 100.0  # The number of boxes at which the rate of a class weighs as much as the rate of all classes.
_RATE_LIMITS = (0.01, 0.95)  # The limits of a class's rate, because at 0 or 1 a single box or miss would be a proof.


@dataclass(frozen=True)
class Rates:
    """Beta distributions of the detection rates in each class. mean: (L,) of each class. concentration: the sum of the two
    parameters of a distribution, the same for all classes."""

    mean: Floats
    concentration: float

    def log_likelihood(self, history: DetectionHistory, label: Ints) -> Floats:
        """Return ln of the probability (N,) of the detections and misses of objects with these labels."""
        return _beta_binomial(history.seen, history.expected, self.mean[label], self.concentration)

    def cost(self, seen: Ints, expected: Ints, label: Ints) -> Floats:
        """Return -2 ln of the probability (N,) that objects with these labels are `seen` times in `expected` frames."""
        return -2 * _beta_binomial(seen, expected, self.mean[label], self.concentration)

    def log_odds(self, history: DetectionHistory, label: Ints) -> Floats:
        """Return the log likelihood ratio (N,) of an object of the class over a phantom, from the detections and misses."""
        rate = self.mean[label]
        phantom = rate * _PHANTOM_SHARE
        # With the concentration 1 / phantom the density of phantom rates decreases from 0 on.
        as_phantom = _beta_binomial(history.seen, history.expected, phantom, 1 / phantom)
        return np.asarray(_beta_binomial(history.seen, history.expected, rate, self.concentration) - as_phantom)


def detection_rates(history: DetectionHistory, label: Ints, labels: int) -> Rates:
    """Estimate the rate of each class (L,) as the median over its boxes. If a class has few boxes, its rate is near the rate
    of all classes. The concentration is the lowest one whose likelihood is not clearly below the best. The likelihoods allow
    any object to be a phantom. label: (N,) of the objects. labels: the number L of all labels."""
    seen, expected = history.seen.astype(float), history.expected
    own = seen / np.maximum(expected, 1)
    overall = weighted_median(own, seen, np.zeros(len(seen), dtype=np.int64), 1)
    boxes = np.bincount(label, seen, labels)
    mean = (boxes * weighted_median(own, seen, label, labels) + _POOLED_BOXES * overall) / (boxes + _POOLED_BOXES)
    rates = [Rates(np.clip(mean, *_RATE_LIMITS), concentration) for concentration in _CONCENTRATIONS]
    likelihood = np.logaddexp(0.0, [rate.log_odds(history, label) for rate in rates]).sum(axis=1)
    return rates[int(np.argmax(likelihood >= likelihood.max() - _CLEAR_LEAD))]


def _beta_binomial(seen: Ints, expected: Ints, rate: Floats, concentration: float | Floats) -> Floats:
    """Return ln of the probability (N,) of a sequence of detections and misses, if the rate has a beta distribution."""
    from scipy.special import betaln

    a, b = concentration * rate, concentration * (1 - rate)
    return np.asarray(betaln(a + seen, b + expected - seen) - betaln(a, b))


def weighted_median(values: Floats, weight: Floats, group: Ints, count: int) -> Floats:
    """Return the weighted median (count,) of each group: half of the weight lies below it. It is 0 without weight."""
    result = np.zeros(count)
    order = np.lexsort((values, group))
    total = np.cumsum(weight[order])
    upper = np.append(0.0, total)[np.cumsum(np.bincount(group, minlength=count))]
    lower = np.append(0.0, upper[:-1])
    some = upper > lower
    result[some] = values[order][np.searchsorted(total, ((lower + upper) / 2)[some])]
    return result
