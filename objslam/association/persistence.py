"""Estimate how likely the objects of a map are still there, session after session, with the persistence filter.

The filter is from Rosen, Mason and Leonard 2016, Towards lifelong feature-based mapping in semi-static environments. The
time for which an object stays is exponentially distributed. So the filter needs only the last probability and the time since
then. A session is one measurement: the session finds the object or misses it. A miss counts only as far as the object was in
view.
"""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import log_beta

LIFETIME = 60.0
"""The mean time (days) that an object stays where it is. A larger value needs more misses before an object is gone. At 60
days, a tenth of the objects change in a week, as in a place where people live."""
_OVERLOOKED = 0.03
"""The probability that all looks of a session miss an object in view for one reason: an error of the map, bad light, or a
person in the way. A larger value needs more misses before an object is gone."""
_BY_CHANCE = 0.02
"""The probability that a session finds something at a place where there is no object. A larger value trusts a find less."""
_CONCENTRATION = 5.0
"""The sum of the parameters of the beta distribution of an object's detection rates in different sessions. With a larger
value, the rates of different sessions are more alike, and many misses count more. Offline association finds values around
this one."""
_RATE = 0.5
"""The assumed share of looks that detect a new object. A larger value makes a miss count more."""
_LOOKS = 4.0
"""The weight of `_RATE`, as a number of looks at the object. A larger value needs more looks to change the rate."""
_LEAST, _MOST = 1e-9, 1 - 1e-9
"""The limits of a probability. They let an object come back after any number of misses."""


def persistence(before: Floats, days: Floats, found: Bools, looks: Ints, past_looks: Ints, past_detections: Ints) -> Floats:
    """Return the probability (N,) that each object is still there after a session.

    Args:
        before: (N,) the probability after the session before.
        days: (N,) the number of days since that session.
        found: (N,) whether the session found the object.
        looks: (N,) in how many frames of the session it should have been detected if it was there.
        past_looks, past_detections: (N,) the looks and detections of all sessions before. They give the detection rate.
    """
    prior = np.clip(before * np.exp(-np.maximum(days, 0.0) / LIFETIME), _LEAST, _MOST)
    missed = np.maximum(missed_by_all(looks, past_looks, past_detections), np.where(looks > 0, _OVERLOOKED, 1.0))
    as_present = np.where(found, 1 - _OVERLOOKED, missed)
    as_absent = np.where(found, _BY_CHANCE, np.where(looks > 0, 1 - _BY_CHANCE, 1.0))
    odds = prior / (1 - prior) * as_present / as_absent
    return np.asarray(np.clip(odds / (1 + odds), _LEAST, _MOST))


def missed_by_all(looks: Ints, past_looks: Ints, past_detections: Ints) -> Floats:
    """Return the probability (N,) that all `looks` miss an object that is there (beta-binomial)."""
    rate = np.clip((past_detections + _RATE * _LOOKS) / (past_looks + _LOOKS), 0.01, 0.99)
    a, b = _CONCENTRATION * rate, _CONCENTRATION * (1 - rate)
    return np.asarray(np.exp(log_beta(a, b + looks) - log_beta(a, b)))
