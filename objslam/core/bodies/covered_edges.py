"""Edges of boxes along which another box of the same image begins.

If thing A hides a part of thing B, the visible part of B ends along the outline of A. So the box of B ends at the edge of
the box of A, or inside the half of that box that is nearer to B.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from objslam.core.arrays import Floats, Ints

_INSIDE = 0.5
"""The share of a box's area up to which another box that covers it may be of a thing in front. With a greater share inside,
the other thing is in front, or the two boxes are of one thing. A larger share finds more hidden edges, and more that are
not."""
_PAIRS_AT_ONCE = 1 << 18
"""About the most pairs of boxes that are compared at once. A larger number needs more memory: 100 bytes a pair."""


def pairs_in_images(image: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield the ordered pairs of different boxes of the same image, in several parts. A part has the indices (P,) of the
    first boxes and the indices (P,) of the second boxes. image: (B,) the image of each box."""
    order = np.argsort(image, kind="stable")
    end = np.searchsorted(image[order], image[order], side="right")
    left = end - np.arange(len(image)) - 1  # The number of later boxes of the image.
    total = np.cumsum(left)
    blocks = np.searchsorted(total, np.arange(0, int(left.sum()), _PAIRS_AT_ONCE), side="right")
    for begin, stop in pairwise([*np.unique(blocks).tolist(), len(image)]):
        number = left[begin:stop]
        first = np.repeat(np.arange(begin, stop), number)
        step = np.arange(len(first)) - np.repeat(np.cumsum(number) - number, number) + 1
        one, other = order[first], order[first + step]
        yield np.concatenate([one, other]), np.concatenate([other, one])


def covered_shares(box: Floats, front: Floats, noise: Floats) -> Floats:
    """Return for each edge of a box (P, 4), px, along which share (P, 4) of its length the box `front` (P, 4), px, may hide
    what is beyond the edge.

    The share is 0 for an edge that `front` does not reach, or does not go beyond. noise: (P,) px, the most by which two
    measurements of one edge differ.
    """
    low, high, near, far = box[:, :2], box[:, 2:], front[:, :2], front[:, 2:]
    shared = np.maximum(np.minimum(high, far) - np.maximum(low, near), 0.0)
    length = np.maximum(high - low, 1e-9)
    middle, noise = (near + far) / 2, noise[:, None]
    ends_high = (high >= near - noise) & (high <= middle + noise) & (far > high + noise)
    ends_low = (low <= far + noise) & (low >= middle - noise) & (near < low - noise)
    along = (shared / length)[:, ::-1]
    beside = (shared / length).prod(axis=1, keepdims=True) < _INSIDE
    return np.concatenate([along * ends_low, along * ends_high], axis=1) * beside
