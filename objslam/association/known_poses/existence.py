"""Estimate how likely a landmark is a static object, from detections, misses, stray rays, sizes and motion. A phantom is a
landmark without an object: rays of different things meet there. A stray ray belongs to no landmark."""

import numpy as np

from objslam.association.known_poses.chance import Strays, chance_odds
from objslam.association.known_poses.detection_rates import detection_rates, weighted_median
from objslam.association.landmarks import State
from objslam.association.refinement import velocity_gain
from objslam.core.arrays import Floats

_MOST_PRIOR = 3.0  # The largest prior odds. A class with few boxes has them. A larger value keeps more weak objects.
_EXPECTED_STRAYS = 5.0  # Each class is assumed to have this number of stray boxes in addition to the observed ones.
_LOG_SIZE = 0.7  # The standard deviation of ln size within a class. It is a factor of 2 in size.
_PHANTOM_LOG_RANGE = 4.6  # The width of the uniform ln size distribution of phantoms. It is a factor of 100 in size.
_REST_PRIOR = 3.0  # The prior log odds of a static object over a moving one. A larger value drops fewer objects.
_WITHIN_SIZE = 0.5  # The share of an object's size that its apparent motion may have, because box centres wander that far.
_COUNTED_RAYS = 10  # The most rays that count as independent in the motion test.


def existence(state: State, gate: float, strays: Strays) -> Floats:
    """Return the probability (N,) that each landmark is a static object."""
    from scipy.special import expit

    rates = detection_rates(state.history, state.label, len(state.unassigned))
    by_rate = prior_odds(state) + rates.log_odds(state.history, state.label) + size_odds(state) + rest_odds(state)
    return np.asarray(expit(by_rate) * expit(chance_odds(state, gate, strays, rates)))


def prior_odds(state: State) -> Floats:
    """Return the prior log odds (N,) of an object, from the numbers of assigned and unassigned boxes of its class."""
    odds = np.log((state.label_count.sum(axis=0) + _EXPECTED_STRAYS * _MOST_PRIOR) / (state.unassigned + _EXPECTED_STRAYS))
    return np.minimum(odds, np.log(_MOST_PRIOR))[state.label]


def stray_share(state: State, gate: float) -> Floats:
    """Return the share (N,) of boxes at random pixels of the images whose rays would pass each landmark within its gate."""
    angle2 = state.variance / np.maximum(state.distance, 1e-3) ** 2
    area = np.pi * gate * np.bincount(state.owner, angle2, state.count) / np.maximum(state.ray_count, 1)
    looks = np.maximum(state.history.inside, state.history.expected)
    return looks * area / (max(len(state.view.camera), 1) * state.view.solid_angle)


def size_odds(state: State) -> Floats:
    """Return the log odds (N,), at most 0, of an object of the class over a phantom, from the landmark's size.

    Crossing rays of different objects give a wrong distance, and so a wrong size.
    """
    own = np.log(np.maximum(state.size, 1e-6))
    usual = weighted_median(own, state.ray_count.astype(float), state.label, len(state.unassigned))[state.label]
    as_object = -0.5 * ((own - usual) / _LOG_SIZE) ** 2 - np.log(_LOG_SIZE * np.sqrt(2 * np.pi))
    return np.asarray(np.minimum(as_object + np.log(_PHANTOM_LOG_RANGE), 0.0))


def rest_odds(state: State) -> Floats:
    """Return the log odds (N,), at most 0, of a static point over a point with constant velocity.

    Rays of a slow object may meet for a while, but a moving point explains them much better. BIC gives the odds from
    the share of the squared deviations that a velocity explains. A box centre wanders over its object as the view changes,
    which looks like motion. So only a few rays count, and motion within the object's size does not count.
    """
    obs, landmarks = state.obs, state.landmarks
    stamps = state.view.stamps[obs.frame[state.assigned]]
    gain, explained, way = velocity_gain(obs, state.assigned, state.owner, landmarks.position, landmarks.noise, stamps)
    size = 2.0 * np.clip(state.ray_count, 1, _COUNTED_RAYS)  # Each ray measures two coordinates.
    # A velocity explains most deviations of few rays, even if these are no larger than their noise.
    gain = np.minimum(-size * np.log(np.clip(1 - explained, 1e-6, 1.0)), gain)
    odds = _REST_PRIOR + 1.5 * np.log(size) - 0.5 * gain
    return np.where(way > _WITHIN_SIZE * state.size, np.minimum(odds, 0.0), 0.0)
