"""Parse the text files of detector boxes. Each file is a frame. Each line is "[class] x y w h score" of a box in px.

The point (x, y) is the top left corner.
"""

from __future__ import annotations

from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.io.box_collector import BoxCollector
from objslam.io.text import parse_numbers, split_lines


def add_boxes(data: bytes, place: str, label: str, collector: BoxCollector, ledger: Ledger) -> None:
    """Add the boxes of a file to the collector's last frame. `place` names the file in messages.

    A line of 6 numbers starts with a COCO class number. A line of 5 numbers gets `label`. Other lines are dropped and counted.
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
                ledger.drop("box line with a class number that is not in COCO", where=where)
                continue
            name = COCO_NAMES[int(values[0])]
        x, y, width, height, score = values[-5:]
        collector.add_box([x, y, x + width, y + height], name, score, where)
