"""Which estimated objects may be one and the same, in a solved log and in a session alike."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats, Ints

TOGETHER = 0.03
"""The share of the frames with two objects that a wrong box may account for; larger merges objects that were seen as two."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Pairs a < b (P,) of objects (N,) of one label less than `farthest` m apart, and the way from b to a (P, 3), m."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Whether frames show two objects to be two: `together` show both, `frames` the one seen less."""
    return together > TOGETHER * frames
