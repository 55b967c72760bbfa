"""Tests of the boxes of a log: do they fit the images of the calibration?"""

from collections.abc import Iterator

import numpy as np

from objslam.core.camera import Camera, spoken_name
from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections, Log
from objslam.core.validity import NO_AREA
from objslam.errors import LogError
from objslam.mapping.checks.finding import Finding

_FEWEST = 20
"""The fewest boxes that are judged, because a few boxes may lie anywhere. The test for boxes between 0 and 1 needs fewer. A
larger number judges fewer logs."""
_PART = 0.9
"""If more than this share of the boxes has no coordinate above 1.5, the boxes are probably shares of the image, not px. A
smaller share also reports logs in which only some boxes have such small coordinates."""
_WITHOUT_AREA = 0.2
"""If more than this share of the boxes has no area, the corners are not x1 y1 x2 y2. No detector writes such boxes. A larger
share warns less often."""
_OUTSIDE = 0.1
"""If more than this share of the boxes has its centre outside the image, the boxes belong to a larger image. A larger share
warns less often."""
_LEAST_SPAN = 0.55
"""The least share of the image's width or height that the boxes of a long log should reach. A larger share warns more
often."""
_LONG = 200
"""The fewest boxes of a long log. The boxes of a long log should cover most of the image. A larger number judges fewer
logs."""


def refuse_shares(log: Log) -> None:
    """Raise a LogError if all boxes of a camera lie between 0 and 1: they are shares of the image.

    Boxes in px with such corners would all lie in one pixel. No detector finds them, so the fault is certain, and no box is
    of use.
    """
    for one in log.cameras:
        found, size = one.detections, one.camera.size.astype(int).tolist()
        if found is not None and len(found) and found.boxes.min() >= 0 and found.boxes.max() <= 1:
            raise LogError(
                f"the boxes of {spoken_name(one.camera.name)} are shares of the image, not px: all lie between 0 and 1",
                where=log.name,
                hint=f"write x1 y1 x2 y2 in px: x times {size[0]}, y times {size[1]}",
            )


def check_boxes(log: Log, ledger: Ledger) -> list[Finding]:
    """Return the findings about the boxes of a log, from their corners alone.

    ledger: the ledger of the reading of the log. The ledger counts the boxes without area, because most readers drop them.
    """
    found: list[Finding] = []
    read = [c.detections.boxes for c in log.cameras if c.detections is not None]
    dropped = ledger.dropped.get(NO_AREA, 0)
    boxes = dropped + sum(map(len, read))
    flat = dropped + sum(int((b[:, 2:] <= b[:, :2]).any(axis=1).sum()) for b in read)
    if boxes >= _FEWEST and flat > _WITHOUT_AREA * boxes:
        found.append(
            Finding(
                "boxes without area",
                f"{100 * flat / boxes:.0f} % of the boxes have x2 <= x1 or y2 <= y1: they are not x1 y1 x2 y2 but probably "
                "x y width height, or centre and size",
            )
        )
    for one in log.cameras:
        if one.detections is not None and len(one.detections):
            first = next(_judge(one.detections, one.camera), None)
            if first is not None:
                found.append(first)
    return found


def _judge(found: Detections, camera: Camera) -> Iterator[Finding]:
    boxes, name = found.boxes, f"boxes of {spoken_name(camera.name)}"
    size = f"{camera.width} x {camera.height} px"
    if (boxes.max(axis=1) <= 1.5).mean() > _PART:
        yield Finding("boxes 0..1", f"the {name} lie between 0 and 1: they are probably shares of the image, not px")
    if len(boxes) < _FEWEST:
        return
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    outside = float(((centre < 0) | (centre > camera.size)).any(axis=1).mean())
    if outside > _OUTSIDE:
        yield Finding(
            "boxes outside",
            f"{100 * outside:.0f} % of the {name} have their centre outside the image of {size}: they belong to a larger "
            "image, or are not x1 y1 x2 y2",
        )
    reach = np.quantile(boxes[:, 2:], 0.99, axis=0) / camera.size
    if len(boxes) >= _LONG and (reach < _LEAST_SPAN).all():
        yield Finding(
            "boxes in a corner",
            f"the {name} reach only {100 * reach[0]:.0f} % of the width and {100 * reach[1]:.0f} % of the height of {size}: "
            "they probably belong to a smaller image",
            spoils=False,
        )
