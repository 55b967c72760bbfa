"""Draw the boxes of a detector on a photo, with labels on plates (filled rectangles) that avoid each other."""

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Array, Floats
from objslam.output.plot.style import colours_of

_LINE = 300  # The ratio of the longer side of the image to the width of a line. A larger number draws thinner lines.
PICTURES = (".png", ".jpg", ".jpeg")  # The possible suffixes of the file of the picture.

Plate = tuple[int, int, int, int]
"""The filled rectangle behind a label: x1, y1, x2, y2, px."""


def draw_boxes(image: Array, boxes: Floats, labels: Sequence[str], scores: Floats, ending: str = ".png") -> bytes:
    """Return a picture of an image (H, W, 3), BGR, with boxes (N, 4) x1, y1, x2, y2, px, in the colours of their labels.

    labels, scores: (N,) the text beside each box. ending: the format of the picture, one of `PICTURES`.
    """
    import cv2

    drawn, line = np.ascontiguousarray(image).copy(), max(1, max(image.shape[:2]) // _LINE)
    colours, plates = colours_of(labels), list[Plate]()
    for box, label, score in zip(boxes.round().astype(int).tolist(), labels, scores.tolist(), strict=True):
        red, green, blue = (round(255 * part) for part in colours[label])
        x1, y1, x2, y2 = box
        cv2.rectangle(drawn, (x1, y1), (x2, y2), (blue, green, red), line)
        text = f"{label} {score:.2f}".encode("ascii", "replace").decode()  # OpenCV's font has only ASCII.
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * line, line)
        wide, high = width + 4 * line, height + 6 * line
        plates.append(free_plate((x1, y1 - high, x1 + wide, y1), plates, drawn.shape[1], drawn.shape[0]))
        left, top, right, bottom = plates[-1]
        cv2.rectangle(drawn, (left, top), (right, bottom), (blue, green, red), cv2.FILLED)
        place = (left + 2 * line, bottom - 3 * line)
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * line, (255, 255, 255), line, cv2.LINE_AA)
    return cv2.imencode(ending, drawn)[1].tobytes()


def free_plate(wanted: Plate, taken: Sequence[Plate], width: int, height: int) -> Plate:
    """Return the plate of a label. The plate `wanted` is moved into the image, and then down to a free place, if possible.

    taken: the plates of earlier labels. width, height: the size of the image, px.
    """
    x1, y1, x2, y2 = wanted
    left, high = max(0, min(x1, width - (x2 - x1))), y2 - y1
    first = max(0, min(y1, height - high))
    right = left + x2 - x1
    top = first
    while below := [b for a, t, c, b in taken if a < right and c > left and t < top + high and b > top]:
        top = max(below)
        if top + high > height:
            return left, first, right, first + high
    return left, top, right, top + high
