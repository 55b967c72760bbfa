"""Draw the boxes of a detector on a photo."""

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Array, Floats
from objslam.output.plot.style import colours_of

_LINE = 300  # The width of a line is the longer side of the image over this number. A larger number draws thinner lines.


def draw_boxes(image: Array, boxes: Floats, labels: Sequence[str], scores: Floats) -> bytes:
    """Return a PNG of an image (H, W, 3), BGR, with boxes (N, 4) x1, y1, x2, y2, px, in the colours of their labels."""
    import cv2

    drawn, line = np.ascontiguousarray(image).copy(), max(1, max(image.shape[:2]) // _LINE)
    colours = colours_of(labels)
    for box, label, score in zip(boxes.round().astype(int).tolist(), labels, scores.tolist(), strict=True):
        red, green, blue = (round(255 * part) for part in colours[label])
        x1, y1, x2, y2 = box
        cv2.rectangle(drawn, (x1, y1), (x2, y2), (blue, green, red), line)
        text = f"{label} {score:.2f}".encode("ascii", "replace").decode()  # the font of OpenCV has ASCII only
        place = (max(x1, 0), max(y1 - 2 * line, 12 * line))
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * line, (blue, green, red), line, cv2.LINE_AA)
    return cv2.imencode(".png", drawn)[1].tobytes()
