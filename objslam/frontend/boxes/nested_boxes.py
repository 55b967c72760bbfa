"""Find second boxes that a detector gives to a thing, around a part of the thing only."""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

PARTS = "boxes inside another box of their label (parts of a thing)"
_INSIDE = 0.9
"""The least share of a box's area inside another box, if the box shows only a part of the thing in that other box. With a
smaller share, more boxes of neighbours that hide each other are dropped."""
_AS_LARGE = 0.3
"""The least area of a box that shows only a part of the thing in another box, as a share of the area of that other box. The
suppression of a detector leaves parts with a share of about a half. A smaller box may show a second thing farther away. With
a smaller share, more boxes are dropped."""
_COMPARED = 32  # The most boxes of a label and frame that each box is compared with. A larger number takes longer.


def parts_of_boxes(boxes: Floats, frame: Ints, label: Ints, scores: Floats, cut: Bools) -> Bools:
    """Return which boxes (M, 4) px show the thing of another box of their frame and label, so that they do not count.

    If one box lies inside another, the box with the higher score counts. If the scores are equal, the outer box counts. If
    the image's edge cuts off the outer box, the thing is cut off, so the inner box does not count.

    frame, label, scores: (M,) of the boxes. cut: (M,) whether the image's edge cuts off each box.
    """
    area = np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0).prod(axis=1)
    order = np.lexsort((-area, -scores, label, frame))
    part = np.zeros(len(boxes), dtype=bool)
    for step in range(1, min(_COMPARED, len(boxes) - 1) + 1):
        first, second = order[:-step], order[step:]
        same = (frame[first] == frame[second]) & (label[first] == label[second])
        if not same.any():
            break
        first, second = first[same], second[same]
        low, high = np.maximum(boxes[first, :2], boxes[second, :2]), np.minimum(boxes[first, 2:], boxes[second, 2:])
        common = np.maximum(high - low, 0.0).prod(axis=1)
        small, large = np.minimum(area[first], area[second]), np.maximum(area[first], area[second])
        nested = (common >= _INSIDE * small) & (small >= _AS_LARGE * large) & (small > 0)
        outer = np.where(area[first] >= area[second], first, second)
        inner = np.where(outer == first, second, first)
        part[np.where(cut[outer], inner, second)[nested]] = True
    return part
