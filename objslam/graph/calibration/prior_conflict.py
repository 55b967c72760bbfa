"""Shared errors that lie far from their priors: by how much the priors were too narrow.

A true value is hardly ever 3 standard deviations from its prior. If an estimate is, the prior is probably too narrow for
this robot. This does not matter if the log alone determines the error. But if the log determines only the sum of two errors,
the priors decide how the sum is divided between the two. Then narrow priors make the covariance too small.
"""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration

_CHANCE = 2.0
"""Up to this many standard deviations, the distance from a prior is chance. A larger number widens fewer priors. Beyond it,
a prior is widened about as much as a Student prior with 4 degrees of freedom would do it. An example is a sum of two errors
that is 3 prior standard deviations of the first error and 4.5 of the second. The standard deviation of each error grows by a
factor of 1.5 here, and by 1.9 with the Student prior."""
_TOLD = 0.9
"""A direction is determined by the log if its variance is at most this share of its prior variance. With a larger share,
directions count that the log hardly shows."""
_LEAST = 1e-12
"""The least variance of a prior. An error whose prior has a smaller variance is known."""


def with_wider_priors(found: Calibration, mean: Floats, prior: Floats) -> Calibration:
    """Return the calibration with the covariance of wider priors if the values are too far from the priors.

    The values stay, and so does the information of the log itself. The check compares the distances of the values from the
    mean (P,) of their prior (P, P) with their expected covariance. This is `prior - covariance`, if both are right (prior
    predictive check; Box 1980). The check is done along each direction that the log determines. If it fails along a
    direction, the priors of the parameters that have a part in this direction become wider. The larger its part, the wider a
    prior becomes.
    """
    if not len(mean):
        return found
    size, axes = np.linalg.eigh(prior)
    inverse = (axes / np.sqrt(np.maximum(size, _LEAST))) @ axes.T
    share, along = np.linalg.eigh(inverse @ found.covariance @ inverse)
    told = share <= _TOLD
    along = along[:, told].T
    off = along @ inverse @ (found.values - mean)
    excess = np.maximum(off**2 / (1 - share[told]) - _CHANCE**2, 0.0)
    if not excess.any():
        return found
    parts = along**2 / (along**2).max(axis=1, keepdims=True)
    factor = np.sqrt(1 + excess @ parts)
    before = np.linalg.inv(prior)
    information = np.linalg.inv(found.covariance) - before
    size, axes = np.linalg.eigh((information + information.T) / 2)
    information = (axes * np.maximum(size, 0.0)) @ axes.T  # Rounding may make information negative.
    wider = np.linalg.inv(information + before / np.outer(factor, factor))
    return replace(found, covariance=np.asarray(wider), prior_factor=factor)
