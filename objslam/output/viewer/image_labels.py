"""Placement of labels below the dots in camera images, for all images at once."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

LETTER, PADDING = 7.3, 12.0  # A letter, and both margins of a label together, have these widths, px on the screen.
_LINE = 21.0  # A label in an image has this height, px on the screen.
_VIEW = (580.0, 350.0)  # The view of a camera has this width and height, px, in a window of 1600 x 900.
_ROWS = 6  # A label hangs at most this many rows below its dot.


def label_rows(frame: Ints, dots: Floats, letters: Ints, size: tuple[float, float]) -> tuple[Floats, Bools]:
    """Place labels in rows, from left to right; each label gets the first free row below its dot.

    Args:
        frame: (S,) the image of each dot.
        dots: (S, 2) px of the image.
        letters: (S,) the length of each label.
        size: width and height of the images, px; the viewer scales an image to its view.
    Returns:
        The places (S, 2) of the labels, px of the image, and a mask (S,) of the labels that were placed.
    """
    scale = min(_VIEW[0] / size[0], _VIEW[1] / size[1])  # px on the screen per px of the image
    half = (letters * LETTER + PADDING) / 2 / scale
    line = _LINE / scale
    order = np.lexsort((dots[:, 0] - half, frame))
    first = np.searchsorted(frame[order], frame[order])
    rank = np.arange(len(order)) - first
    row = np.ceil(dots[:, 1] / line).astype(np.int64)
    frames = int(frame.max()) + 1 if len(frame) else 0
    until = np.full((frames, int(np.ceil(size[1] / line)) + _ROWS + 1), -np.inf)  # Each row is occupied up to this px.
    hung, found = dots.copy(), np.zeros(len(dots), dtype=bool)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        mine = order[rank == k]  # the k-th label of each frame
        for below in range(_ROWS):
            at = row[mine] + below
            free = until[frame[mine], at] <= dots[mine, 0] - half[mine]
            take = mine[free]
            until[frame[take], at[free]] = dots[take, 0] + half[take]
            hung[take, 1] = at[free] * line
            found[take] = True
            mine = mine[~free]
    return hung, found
