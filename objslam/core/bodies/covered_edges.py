"""Edges of boxes along which another box of the same image begins.

If a thing hides a part of another thing, the visible part of the other ends along the outline of the first. So the box of
the visible part ends at the box of the thing in front, or inside its nearer half.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

_INSIDE = 0.5
"""A thing in front leaves less than this share of the other box inside its own box. With more, the other thing is in front,
or the two boxes are of one thing. A larger share finds more hidden edges, and more that are not."""


def pairs_in_images(image: Ints) -> tuple[Ints, Ints]:
    """Return the ordered pairs (P,) and (P,) of different boxes of one image. image: (B,) of each box."""
    order = np.argsort(image, kind="stable")
    end = np.searchsorted(image[order], image[order], side="right")
    left = end - np.arange(len(image)) - 1  # The number of later boxes of the image.
    first = np.repeat(np.arange(len(image)), left)
    step = np.arange(len(first)) - np.repeat(np.cumsum(left) - left, left) + 1
    one, other = order[first], order[first + step]
    return np.concatenate([one, other]), np.concatenate([other, one])


def covered_shares(box: Floats, front: Floats, noise: Floats) -> Floats:
    """Return the share (P, 4) of each edge of a box (P, 4), px, along which a box in front (P, 4), px, may begin.

    It is 0 for an edge that the other box does not reach, or does not go beyond. noise: (P,) px, the most by which two
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


def covered_edges(box: Floats, front: Floats, noise: Floats, of: Ints, count: int, least: float) -> Bools:
    """Return the edges (count, 4) of boxes of which boxes in front cover more than a share `least` together.

    box, front, noise: (P, 4), (P, 4) and (P,) of pairs, as in `covered_shares`. of: (P,) the number of the box of each pair.
    """
    total = np.zeros((count, 4))
    np.add.at(total, of, covered_shares(box, front, noise))
    return total > least
