"""Find estimated objects that may be duplicates, in a solved log and in a live session."""

import numpy as np

from objslam.core.arrays import Floats, Ints

TOGETHER = 0.03
"""Objects that are seen together in more than this share of frames differ. With a larger share, different objects merge."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Return the pairs a < b (P,) of objects of one label that are less than `farthest` m apart, and
    their offsets a - b (P, 3) m."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Return whether two objects differ. frames: how many frames show the rarer object. together: how many show both
    objects."""
    return together > TOGETHER * frames
