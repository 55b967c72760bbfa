"""Find shared errors that lie far from their priors, and by how much these priors were too narrow.

A true value is hardly ever 3 standard deviations from its prior. If an estimate lies so far away, the prior is probably too
narrow for this robot. This does not matter if the log alone determines the error. But if the log determines only the sum of
two errors, the priors decide how the sum is divided between the two. Then narrow priors make the covariance too small.
"""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration

_CHANCE = 2.0
"""The distance from a prior, in standard deviations, up to which chance explains it. A larger distance widens fewer priors.
Beyond it, a prior is widened about as much as a Student prior with 4 degrees of freedom would widen. An example is a sum of
two errors that is 3 prior standard deviations of the first error and 4.5 of the second. The standard deviation of each error
grows by a factor of 1.5 here, and by 1.9 with the Student prior."""
_TOLD = 0.9
"""The largest ratio of the variance of a direction to its prior variance at which the log determines the direction. With a
larger ratio, directions that the log hardly shows count too."""
_LEAST = 1e-12
"""The least variance of a prior. An error whose prior has a smaller variance is known."""


def with_wider_priors(found: Calibration, mean: Floats, prior: Floats) -> Calibration:
    """Return the calibration with the covariance of wider priors if the values are too far from the priors.

    The values stay, and so does the information of the log itself. The check compares the distances of the values from the
    mean (P,) of their prior (P, P) with the expected covariance of the distances. This covariance is `prior - covariance` if
    both are right (prior predictive check; Box 1980). The check is done along each direction that the log determines. If it
    fails along a direction, the priors of the parameters with a part in this direction become wider. The larger the part of
    a parameter, the wider its prior becomes.
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
