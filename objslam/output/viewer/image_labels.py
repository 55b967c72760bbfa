"""Where names hang under the dots of camera images so that none covers another, for all images at once."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

LETTER, PADDING = 7.3, 12.0  # The width, px on the screen, of a letter in the viewer and of a label's two margins together.
_LINE = 21.0  # The height, px on the screen, of a label in an image.
_VIEW = (580.0, 350.0)  # Width and height, px, of a camera's view in a window of 1600 x 900.
_ROWS = 6  # The largest number of lines that a label hangs below its dot.


def label_rows(frame: Ints, dots: Floats, letters: Ints, size: tuple[float, float]) -> tuple[Floats, Bools]:
    """Hang labels in rows: from left to right, each takes the first row below its dot that is free there.

    Args:
        frame: (S,) the image of each dot.
        dots: (S, 2) px of the image.
        letters: (S,) the length of each label.
        size: width and height of the images, px; the viewer shows them as large as they fit into their view.
    Returns:
        Where labels hang (S, 2), px of the image, and which of them (S,) found room.
    """
    scale = min(_VIEW[0] / size[0], _VIEW[1] / size[1])  # px of the screen for one of the image
    half = (letters * LETTER + PADDING) / 2 / scale
    line = _LINE / scale
    order = np.lexsort((dots[:, 0] - half, frame))
    first = np.searchsorted(frame[order], frame[order])
    rank = np.arange(len(order)) - first
    row = np.ceil(dots[:, 1] / line).astype(np.int64)
    frames = int(frame.max()) + 1 if len(frame) else 0
    until = np.full((frames, int(np.ceil(size[1] / line)) + _ROWS + 1), -np.inf)  # px up to which each row is taken
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
