"""Text files of detector boxes, one file a frame: "[class] x y w h score" a line, x y the top left corner in px."""

from __future__ import annotations

from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.io.box_collector import BoxCollector
from objslam.io.text import parse_numbers, split_lines


def add_boxes(data: bytes, place: str, label: str, collector: BoxCollector, ledger: Ledger) -> None:
    """Add the boxes of one file to the frame begun last.

    Lines of 5 numbers carry no class and get `label`; of 6, a COCO class number first. Malformed lines are dropped and
    counted; `place` names the file.
    """
    for number, text in split_lines(data, place, ledger):
        where = f"{place}:{number}"
        values = parse_numbers(text.split())
        if values is None or len(values) not in (5, 6):
            ledger.drop('box line that is not "[class] x y w h score"', where=where)
            continue
        name = label
        if len(values) == 6:
            if values[0] not in range(len(COCO_NAMES)):
                ledger.drop("box line with a class that COCO does not have", where=where)
                continue
            name = COCO_NAMES[int(values[0])]
        x, y, width, height, score = values[-5:]
        collector.add_box([x, y, x + width, y + height], name, score, where)
