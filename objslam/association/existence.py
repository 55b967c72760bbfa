"""Is there an object at rest at all? Boxes where it should be say so; misses, strays, odd sizes and motion deny it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.landmarks import State
from objslam.association.refinement import velocity_gain
from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Floats, Ints

_PHANTOM_SHARE = 1 / 8  # How often a phantom is detected where it should be, as a share of the rate of its class.
_CONCENTRATIONS = (3.0, 5.0, 8.0, 13.0, 21.0, 34.0, 55.0)  # Tried values of how alike the rates of a class are.
_CLEAR_LEAD = 5.0  # The ln likelihood by which the best concentration must beat a lower one, which drops fewer objects.
_POOLED_BOXES = 100.0  # The boxes with which the rate of a class weighs as much as the rate of all classes.
_RATE_LIMITS = (0.01, 0.95)  # The rates that a class may have: at 0 or 1 a single box, or a single miss, would be a proof.
_MOST_PRIOR = 3.0  # The most that prior odds can be, which a class with few boxes has; larger keeps more weak objects.
_EXPECTED_STRAYS = 5.0  # The stray boxes that every class is taken to have besides those that were seen.
_LOG_SIZE = 0.7  # The standard deviation of ln size within a class: a factor of 2.
_PHANTOM_LOG_RANGE = 4.6  # The width of the range of ln size in which a phantom may have any size: a factor of 100.
_MOST_ODDS = 20.0  # The most that log odds against chance count; it only keeps them finite.
_REST_PRIOR = 3.0  # The log odds of rest against motion before the rays are looked at; larger drops fewer objects.
_WITHIN_SIZE = 0.5  # The share of an object's size within which it may seem to move: its box's middle wanders that far.
_COUNTED_RAYS = 10  # The most rays that count as independent when motion is judged.


@dataclass(frozen=True)
class Rates:
    """How often objects of each class are detected where they should be.

    mean: (L,). concentration: the sum of the parameters of the beta distribution of an object's rate about that mean.
    """

    mean: Floats
    concentration: float

    def cost(self, seen: Ints, expected: Ints, label: Ints) -> Floats:
        """-2 ln of the probability (N,) that objects of these labels (N,) are detected in just those frames."""
        return -2 * _beta_binomial(seen, expected, self.mean[label], self.concentration)

    def log_odds(self, history: DetectionHistory, label: Ints) -> Floats:
        """Log odds (N,) of an object of its class against a phantom, by how often it was detected."""
        return _odds(history.seen, history.expected, self.mean[label], self.concentration)


def detection_rates(history: DetectionHistory, label: Ints, labels: int) -> Rates:
    """The rate of each class: the median over its boxes, drawn to that of all classes where boxes are few.

    The concentration is the lowest one that is not clearly less likely than the best. Each object may be real or a phantom.
    """
    seen, expected = history.seen.astype(float), history.expected
    own = seen / np.maximum(expected, 1)
    overall = _weighted_median(own, seen, np.zeros(len(seen), dtype=np.int64), 1)
    boxes = np.bincount(label, seen, labels)
    mean = (boxes * _weighted_median(own, seen, label, labels) + _POOLED_BOXES * overall) / (boxes + _POOLED_BOXES)
    mean = np.clip(mean, *_RATE_LIMITS)
    odds = np.array([_odds(history.seen, expected, mean[label], c) for c in _CONCENTRATIONS])
    likelihood = np.logaddexp(0.0, odds).sum(axis=1)
    return Rates(mean, _CONCENTRATIONS[int(np.argmax(likelihood >= likelihood.max() - _CLEAR_LEAD))])


def _odds(seen: Ints, expected: Ints, rate: Floats, concentration: float) -> Floats:
    phantom = rate * _PHANTOM_SHARE
    as_phantom = _beta_binomial(seen, expected, phantom, 1 / phantom)  # with 1 / phantom the density falls from rate 0 on
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


def existence(state: State, gate: float) -> Floats:
    """How likely each landmark is an object at rest (N,)."""
    from scipy.special import expit

    rates = detection_rates(state.history, state.label, len(state.unassigned))
    by_rate = prior_odds(state) + rates.log_odds(state.history, state.label) + size_odds(state) + rest_odds(state)
    return np.asarray(expit(by_rate) * expit(chance_odds(state, gate)))


def chance_odds(state: State, gate: float) -> Floats:
    """Log odds (N,) that the rays of each object do not meet by chance.

    Any two strays of its class make a point; rays without object, and rays of objects that have no more than it, are strays.
    How many other strays pass that point within the gate is Poisson distributed.
    """
    from scipy.stats import poisson

    strays = _no_stronger(state.ray_count, state.label) + state.unassigned[state.label]
    expected = strays * stray_share(state, gate)
    points = np.log(np.maximum(strays * (strays - 1) / 2, 1.0))
    return np.asarray(np.clip(-points - poisson.logsf(state.ray_count - 3, expected), -_MOST_ODDS, _MOST_ODDS))


def prior_odds(state: State) -> Floats:
    """Log odds (N,) of an object before its own boxes are looked at: how many boxes of its class have an object."""
    odds = np.log((state.label_count.sum(axis=0) + _EXPECTED_STRAYS * _MOST_PRIOR) / (state.unassigned + _EXPECTED_STRAYS))
    return np.minimum(odds, np.log(_MOST_PRIOR))[state.label]


def stray_share(state: State, gate: float) -> Floats:
    """The share (N,) of boxes thrown anywhere into the images that would pass each landmark within its gate."""
    angle2 = state.variance / np.maximum(state.distance, 1e-3) ** 2
    area = np.pi * gate * np.bincount(state.owner, angle2, state.count) / np.maximum(state.ray_count, 1)
    looks = np.maximum(state.history.inside, state.history.expected)
    return looks * area / (max(len(state.view.camera), 1) * state.view.solid_angle)


def size_odds(state: State) -> Floats:
    """Log odds (N,), at most 0, of an object of its class against a phantom, by its size.

    Where rays of different things cross, the distance is wrong, and so is the size that a box gives there.
    """
    own = np.log(np.maximum(state.size, 1e-6))
    usual = _weighted_median(own, state.ray_count.astype(float), state.label, len(state.unassigned))[state.label]
    as_object = -0.5 * ((own - usual) / _LOG_SIZE) ** 2 - np.log(_LOG_SIZE * np.sqrt(2 * np.pi))
    return np.asarray(np.minimum(as_object + np.log(_PHANTOM_LOG_RANGE), 0.0))


def _no_stronger(number: Ints, label: Ints) -> Ints:
    """The rays (N,) of all objects of an object's class that have no more rays than it, itself included."""
    order = np.lexsort((number, label))
    total = np.append(0, np.cumsum(number[order]))
    rank = label[order] * (int(number.max(initial=0)) + 1) + number[order]
    first, last = np.searchsorted(label[order], label[order]), np.searchsorted(rank, rank, side="right")
    result = np.empty(len(number), dtype=np.int64)
    result[order] = total[last] - total[first]
    return result


def rest_odds(state: State) -> Floats:
    """Log odds (N,), at most 0, of a point at rest against one of constant velocity.

    Rays of a thing that moves slowly can meet for a while, but a moving point explains them much better. The odds are by
    BIC, from the share of the squared deviations that a velocity explains. The middle of a box wanders over its object as
    the view changes, which looks like motion. So only a few rays count, and a way within the object's size is none.
    """
    stamps = state.view.stamps[state.obs.frame[state.assigned]]
    explained, way = velocity_gain(
        state.obs, state.assigned, state.owner, state.landmarks.position, state.landmarks.noise, stamps
    )
    size = 2.0 * np.clip(state.ray_count, 1, _COUNTED_RAYS)  # each ray measures two coordinates
    odds = _REST_PRIOR + 1.5 * np.log(size) + 0.5 * size * np.log(np.clip(1 - explained, 1e-6, 1.0))
    return np.where(way > _WITHIN_SIZE * state.size, np.minimum(odds, 0.0), 0.0)
