"""Find estimated objects that may be duplicates, in a solved log and in a live session."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats, Ints

TOGETHER = 0.03
"""The share of frames with both of two objects that wrong boxes can explain; larger merges objects seen as two."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Return the pairs a < b (P,) of objects (N,) of one label closer than `farthest` m, and the offsets b to a (P, 3) m."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Return whether two objects differ. `together` frames show both, and `frames` frames show the rarer object."""
    return together > TOGETHER * frames
