"""Is there an object at all? Boxes where it should be speak for it, misses, strays and odd sizes against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.landmarks import State, sizes, variance
from objslam.association.sightings import Sightings
from objslam.association.visibility import View, Visits
from objslam.types import Floats, Ints

_PHANTOM_SHARE = 1 / 8  # how often a phantom is detected where it should be, of how often an object of its class is
_CONCENTRATIONS = (3.0, 5.0, 8.0, 13.0, 21.0, 34.0, 55.0)  # tried for how alike the rates of the objects are
_CLEARLY = 5.0  # ln likelihood
_POOLED = 100.0  # boxes: a class with so many weighs its own rate as much as that of all classes
_RATES = (0.01, 0.95)
_PRIOR = 3.0  # the most that odds without looking can be, and what they are for a class with few boxes
_DOUBT = 5.0  # stray boxes that every class is reckoned to have
_LOG_SIZE = 0.7  # standard deviation of ln size within a class,
_PHANTOM_LOG_SIZES = 4.6  # and the width of the range in which a phantom may have any: a factor of 100
_SURE = 20.0  # log odds that need no more


@dataclass(frozen=True)
class Rates:
    """How often objects of each class are detected where they should be.

    mean: (L,). concentration: of the beta distribution of a rate about the mean of its class, the sum of its parameters.
    """

    mean: Floats
    concentration: float

    def cost(self, seen: Ints, expected: Ints, kind: Ints) -> Floats:
        """-2 ln of the probability (N,) that objects of these classes are detected in just those frames."""
        return -2 * _beta_binomial(seen, expected, self.mean[kind], self.concentration)

    def log_odds(self, visits: Visits, kind: Ints) -> Floats:
        """For an object of its class against a phantom (N,), by how often it was detected."""
        return _odds(visits.seen, visits.expected, self.mean[kind], self.concentration)


def detection_rates(visits: Visits, kind: Ints, labels: int) -> Rates:
    """The rates of the classes: the median over their boxes, drawn to that of all classes where boxes are few.

    The concentration is the lowest that is not clearly less likely than the best, if each object may be real or a phantom.
    """
    seen, expected = visits.seen.astype(float), visits.expected
    own = seen / np.maximum(expected, 1)
    overall = _weighted_median(own, seen, np.zeros(len(seen), dtype=np.int64), 1)
    boxes = np.bincount(kind, seen, labels)
    mean = (boxes * _weighted_median(own, seen, kind, labels) + _POOLED * overall) / (boxes + _POOLED)
    mean = np.clip(mean, *_RATES)
    odds = np.array([_odds(visits.seen, expected, mean[kind], c) for c in _CONCENTRATIONS])
    likelihood = np.logaddexp(0.0, odds).sum(axis=1)
    return Rates(mean, _CONCENTRATIONS[int(np.argmax(likelihood >= likelihood.max() - _CLEARLY))])


def _odds(seen: Ints, expected: Ints, rate: Floats, concentration: float) -> Floats:
    phantom = rate * _PHANTOM_SHARE
    as_phantom = _beta_binomial(seen, expected, phantom, 1 / phantom)  # a density that falls from rate 0 on
    return np.asarray(_beta_binomial(seen, expected, rate, concentration) - as_phantom)


def _beta_binomial(seen: Ints, expected: Ints, rate: Floats, concentration: float | Floats) -> Floats:
    """ln of the probability of one sequence of detections and misses, the rate being beta distributed."""
    from scipy.special import betaln

    a, b = concentration * rate, concentration * (1 - rate)
    return np.asarray(betaln(a + seen, b + expected - seen) - betaln(a, b))


def _weighted_median(values: Floats, weight: Floats, group: Ints, count: int) -> Floats:
    """The value (count,) of each group with half the weight below; 0 where there is none."""
    result = np.zeros(count)
    order = np.lexsort((values, group))
    total = np.cumsum(weight[order])
    end = np.cumsum(np.bincount(group, minlength=count))
    upper = np.append(0.0, total)[end]
    lower = np.append(0.0, upper[:-1])
    some = upper > lower
    result[some] = values[order][np.searchsorted(total, ((lower + upper) / 2)[some])]
    return result


def chance_odds(s: Sightings, state: State, kind: Ints, visits: Visits, view: View, gate: float) -> Floats:
    """Log odds (N,) that the rays of each object do not meet by chance.

    Strays of its class (rays without object, and those of objects with no more rays than it has) make points by the pair.
    How many further rays pass such a point within the gate, of all frames that look at it, is Poisson distributed.
    """
    from scipy.stats import poisson

    number = state.number
    free = np.bincount(s.label[state.matched < 0], minlength=state.landmarks.accepts.shape[1])
    strays = _no_stronger(number, kind) + free[kind]
    expected = strays * stray_share(s, state, visits, view, gate)
    points = np.log(np.maximum(strays * (strays - 1) / 2, 1.0))
    return np.asarray(np.clip(-points - poisson.logsf(number - 3, expected), -_SURE, _SURE))


def prior_odds(s: Sightings, state: State, kind: Ints) -> Floats:
    """Log odds (N,) of an object of its class before its own boxes are looked at: how many boxes of the class have one."""
    labels = state.landmarks.accepts.shape[1]
    held = np.bincount(s.label[state.matched >= 0], minlength=labels)
    free = np.bincount(s.label[state.matched < 0], minlength=labels)
    odds = np.log((held + _DOUBT * _PRIOR) / (free + _DOUBT))
    return np.minimum(odds, np.log(_PRIOR))[kind]


def stray_share(s: Sightings, state: State, visits: Visits, view: View, gate: float) -> Floats:
    """The share (N,) of boxes thrown anywhere into the images that would pass each landmark within its gate."""
    count, held = len(state.landmarks), np.flatnonzero(state.matched >= 0)
    index = state.matched[held]
    distance = np.maximum(np.linalg.norm(state.landmarks.position[index] - s.origin[held], axis=1), 1e-3)
    angle2 = variance(s.take(held), distance, state.landmarks.noise[index]) / distance**2
    area = np.pi * gate * np.bincount(index, angle2, count) / np.maximum(state.number, 1)
    return np.maximum(visits.inside, visits.expected) * area / (max(len(view), 1) * view.solid_angle)


def size_odds(s: Sightings, state: State, kind: Ints) -> Floats:
    """Log odds (N,), at most 0, of an object of its class against a phantom, by how large its boxes say it is.

    Rays of different things that cross make a point at a wrong distance, where a box says a wrong size.
    """
    own = np.log(np.maximum(sizes(s, state), 1e-6))
    usual = _weighted_median(own, state.number.astype(float), kind, state.landmarks.accepts.shape[1])[kind]
    as_object = -0.5 * ((own - usual) / _LOG_SIZE) ** 2 - np.log(_LOG_SIZE * np.sqrt(2 * np.pi))
    return np.asarray(np.minimum(as_object + np.log(_PHANTOM_LOG_SIZES), 0.0))


def _no_stronger(number: Ints, kind: Ints) -> Ints:
    """The rays (N,) of all objects of an object's class that have no more rays than it, itself included."""
    order = np.lexsort((number, kind))
    total = np.append(0, np.cumsum(number[order]))
    rank = kind[order] * (int(number.max(initial=0)) + 1) + number[order]
    first, last = np.searchsorted(kind[order], kind[order]), np.searchsorted(rank, rank, side="right")
    result = np.empty(len(number), dtype=np.int64)
    result[order] = total[last] - total[first]
    return result
