"""Record from which distances and sides an object was seen."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import evenly_spread
from objslam.core.object_map import SeenFrom
from objslam.core.statistics import grouped_sums

_SIDES = 103  # The number of sides of an object, 20 degrees apart on the sphere. With a larger number, sides are narrower.


def seen_from(position: Floats, origins: Floats) -> SeenFrom:
    """Return the distances and directions from which cameras detected an object. position: (3,) m, of the object. origins:
    (n, 3) m, of the cameras."""
    toward = origins - position
    distance = np.linalg.norm(toward, axis=1)
    sides = thinned(toward / np.maximum(distance, 1e-9)[:, None])
    return SeenFrom(round(float(distance.min()), 3), round(float(distance.max()), 3), sides)


def thinned(directions: Floats) -> Floats:
    """Return the mean direction (S, 3) of each group of unit directions (n, 3). The groups are about 20 degrees wide."""
    cell = (directions @ evenly_spread(_SIDES).T).argmax(axis=1)
    number, group = np.unique(cell, return_inverse=True)
    mean = grouped_sums(directions, group.ravel(), len(number))
    return np.asarray(np.round(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9), 4))
