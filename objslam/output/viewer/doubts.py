"""Log doubts to a recording: objects that may be one object or two, and places of many boxes that became no object."""

from typing import Any

import rerun as rr

from objslam.core.result import Doubt, RunResult
from objslam.errors import printable

_COLOUR = (196, 88, 0)  # The RGB colour of doubts, which no label and no ray has.


def log_doubts(recording: Any, result: RunResult) -> None:
    """Log doubts as static points with captions to `map/doubts`. Log lines between two objects that may be one to
    `map/doubts/pairs`."""
    placed = [(one, one.position) for one in result.doubts if one.position is not None]
    if placed:
        texts = [caption(one) for one, _ in placed]
        points = rr.Points3D(
            [at for _, at in placed], colors=[_COLOUR], labels=texts, radii=rr.Radius.ui_points(6), show_labels=True
        )
        recording.log("map/doubts", points, static=True)
    position = {o.id: o.position for o in result.map.objects}
    pairs = [[position[one.objects[0]], position[one.objects[1]]] for one in result.doubts if one.kind == "pair"]
    if pairs:
        lines = rr.LineStrips3D(pairs, colors=[_COLOUR], radii=rr.Radius.ui_points(1.5))
        recording.log("map/doubts/pairs", lines, static=True)


def caption(doubt: Doubt) -> str:
    """Return a short text that describes a doubt."""
    boxes = len(doubt.rays) or int(doubt.numbers.get("boxes_cut_off", 0))
    number = f"{boxes} " if doubt.kind == "boxes" else ""
    return printable(f"{number}{doubt.label}: {doubt.reason}")
