"""Find objects and boxes that may be duplicates, in a solved log and in a live session."""

import numpy as np

from objslam.association.observations import overlap
from objslam.core.arrays import Bools, Floats, Ints

_ONE_THING = 1 / 3
"""The least intersection over union of two boxes of one label and frame that may show one thing. Two boxes of equal size
with this value cover half of each other. The non-maximum suppression of detectors leaves second boxes with values below 0.45
to 0.7. Boxes of things side by side have 0. Boxes of a thing and of a thing behind it have a larger value from a few places
only. With a larger value, second boxes become objects."""
TOGETHER = 0.03
"""The largest share of the rarer object's frames that may show both objects if the two are one thing. With a larger share,
different objects merge."""


def near_pairs(position: Floats, label: Ints, farthest: float) -> tuple[Ints, Ints, Floats]:
    """Return the pairs a < b (P,) of objects of one label that are less than `farthest` m apart, and
    their offsets a - b (P, 3) m."""
    a, b = np.triu_indices(len(position), 1)
    apart = position[a] - position[b]
    near = (label[a] == label[b]) & (np.linalg.norm(apart, axis=1) < farthest)
    return a[near], b[near], apart[near]


def seen_as_two(together: int, frames: int) -> bool:
    """Return whether two objects differ. frames: the number of frames that show the rarer object. together: the number of
    frames that show both objects."""
    return together > TOGETHER * frames


def may_be_one(box: Floats, label: Ints) -> Bools:
    """Return which pairs (n, n) of different boxes (n, 4), px, of a frame may show one thing. label: (n,)."""
    same = label[:, None] == label
    np.fill_diagonal(same, False)
    return same & show_one_thing(box[:, None], box) if same.any() else same


def show_one_thing(boxes: Floats, others: Floats) -> Bools:
    """Return whether boxes (..., 4) and others (..., 4) of one frame, px, lie so much on each other that they may show one
    thing."""
    return np.asarray(overlap(boxes, others) >= _ONE_THING)
