"""Find estimated objects that may be duplicates, in a solved log and in a live session."""

import numpy as np

from objslam.core.arrays import Floats, Ints

TOGETHER = 0.03
"""If two objects are seen together in more than this share of frames, they differ. A larger share merges separate
objects."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Return the pairs a < b (P,) of objects with one label that are less than `farthest` m apart, and the offsets (P, 3) m
    from b to a."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Return whether two objects differ. `frames` frames show the rarer one, and `together` of them show both."""
    return together > TOGETHER * frames
