"""Find estimated objects that may be duplicates, in a solved log and in a live session."""

import numpy as np

from objslam.core.arrays import Floats, Ints

TOGETHER = 0.03
"""The largest share of frames that may show both duplicates because of wrong boxes; larger merges separate objects."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Return the pairs a < b (P,) of objects (N,) of one label within `farthest` m, and the offsets (P, 3) m from b to a."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Return whether two objects differ. `together` frames show both, and `frames` frames show the rarer object."""
    return together > TOGETHER * frames
