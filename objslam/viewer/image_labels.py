"""Names under the dots of an image, for all images at once, none over another."""

from __future__ import annotations

import numpy as np

from objslam.types import Bools, Floats, Ints

_VIEW = (580.0, 350.0)  # px of a camera's view in a window of 1600 x 900
_LETTER, _PADDING, _LINE = 7.3, 12.0, 21.0  # px of a label on the screen: a letter, both its sides, its height
_ROWS = 6  # a label hangs at most so many lines below its dot


def label_rows(frame: Ints, dots: Floats, letters: Ints, size: tuple[float, float]) -> tuple[Floats, Bools]:
    """Where labels hang (S, 2), px, below dots (S, 2) of frames (S,), and which of them (S,) found room.

    letters: (S,) how long each is. size: of the image, px, as large as it fits into its view. Labels stand in rows; from
    left to right each takes the first row below its dot that is free where it is.
    """
    scale = min(_VIEW[0] / size[0], _VIEW[1] / size[1])  # px of the screen for one of the image
    half = (letters * _LETTER + _PADDING) / 2 / scale
    line = _LINE / scale
    order = np.lexsort((dots[:, 0] - half, frame))
    first = np.searchsorted(frame[order], frame[order])
    rank = np.arange(len(order)) - first
    row = np.ceil(dots[:, 1] / line).astype(np.int64)
    frames = int(frame.max()) + 1 if len(frame) else 0
    until = np.full((frames, int(np.ceil(size[1] / line)) + _ROWS + 1), -np.inf)  # how far each row is taken, px
    hung, found = dots.copy(), np.zeros(len(dots), dtype=bool)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        mine = order[rank == k]  # the k-th label of every frame
        for below in range(_ROWS):
            at = row[mine] + below
            free = until[frame[mine], at] <= dots[mine, 0] - half[mine]
            take = mine[free]
            until[frame[take], at[free]] = dots[take, 0] + half[take]
            hung[take, 1] = at[free] * line
            found[take] = True
            mine = mine[~free]
    return hung, found
