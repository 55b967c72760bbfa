"""Read and write detections.jsonl, which has one line of JSON per camera frame. Here, a frame is an image with its boxes."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.appearance.features import short_numbers
from objslam.core.diagnostics import Ledger
from objslam.core.types import MAX_BOXES, Detections
from objslam.core.validity import NO_LABEL
from objslam.errors import LogError
from objslam.io.box_collector import BoxCollector
from objslam.io.text import in_order, misspelt, read_lines, require_order

MALFORMED = "detection frame malformed: "
"""The first words of the reason in the ledger for each malformed frame."""
_KEYS = frozenset(("stamp", "boxes", "labels", "scores", "depths", "track_ids", "corners", "features", "whole"))
_EXAMPLE = 'a line is {"stamp": 12.5, "boxes": [[x1, y1, x2, y2]], "labels": ["cup"], "scores": [0.9]}'


class Malformed(ValueError):
    """A line is malformed, for the reason in the message."""


def read_detections(path: Path, ledger: Ledger) -> Detections:
    """Read a detections file. Boxes are in px of the raw image, timestamps in s, and depths z along the optical axis in m.

    Malformed lines, frames out of time order and invalid boxes are dropped and counted. A key that is probably misspelt
    gives a warning. Raises LogError if no line is a frame, or if most frames are out of time order.
    """
    collector = BoxCollector()
    lines = read_lines(path, ledger)
    if lines and lines[0][1].strip() == "[":  # Only the last frame of a list is valid JSON, because no comma follows it.
        hint = "write one frame a line, without brackets around them and commas between them"
        raise LogError("the file is one JSON list", where=str(path), hint=hint)
    whole, reasons, keys = True, Counter[str](), set[str]()
    for number, text in lines:
        place = f"{path}:{number}"
        try:
            frame = parse_object(text)
            keys |= frame.keys()
            whole &= add_frame(frame, place, collector)
        except Malformed as malformed:
            ledger.drop(f"{MALFORMED}{malformed}", where=place)
            reasons[str(malformed)] += 1
    for reason in reasons:
        ledger.drop(f"{MALFORMED}{reason}", 0, of=len(lines))
    for key, meant in misspelt(sorted(keys), _KEYS).items():
        ledger.warn(f"{path}: the key {key!r} is not known, and is not read (did you mean {meant!r}?)")
    if not collector.stamps:
        if not lines:
            hint = "write the boxes into it, or remove it and run a detector on the images of rgb.txt (--detector)"
            raise LogError("the file has no detection frame", where=str(path), hint=hint)
        why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
        hint = "the file is one JSON list: write one frame a line" if lines[0][1].startswith("[") else _EXAMPLE
        raise LogError(f"none of its {len(lines)} lines is a detection frame{why}", where=str(path), hint=hint)
    require_order(in_order(np.array(collector.stamps, dtype=np.float64)), path)
    return replace(collector.checked(ledger), whole=whole)


def write_detections(detections: Detections, path: Path) -> None:
    """Write a detections file. Every number is read back as the same float. Unknown depths and track ids are null."""
    bounds = np.searchsorted(detections.frame, np.arange(len(detections.frame_stamps) + 1)).tolist()
    columns: dict[str, list[Any]] = {
        "boxes": detections.boxes.tolist(),
        "labels": [detections.label_names[i] for i in detections.label.tolist()],
        "scores": detections.scores.tolist(),
    }
    if not np.isnan(detections.depths).all():
        columns["depths"] = [None if math.isnan(depth) else depth for depth in detections.depths.tolist()]
    if (detections.track_ids >= 0).any():
        columns["track_ids"] = [None if track_id < 0 else track_id for track_id in detections.track_ids.tolist()]
    if detections.corners is not None and not np.isnan(detections.corners).all():
        columns["corners"] = [None if math.isnan(c[0][0]) else c for c in detections.corners.tolist()]
    features = detections.features if detections.features is not None and not np.isnan(detections.features).all() else None
    whole = {"whole": True} if detections.whole else {}
    with path.open("w", encoding="utf-8") as file:
        for stamp, start, end in zip(detections.frame_stamps.tolist(), bounds[:-1], bounds[1:], strict=True):
            frame = {"stamp": stamp} | {name: column[start:end] for name, column in columns.items()} | whole
            if features is not None:
                frame["features"] = [short_numbers(vector) for vector in features[start:end]]
            file.write(json.dumps(frame, ensure_ascii=False, allow_nan=False) + "\n")


def parse_object(text: str | bytes) -> dict[str, Any]:
    """Return the JSON object that a line contains. Raises Malformed for other content."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Malformed("not JSON") from error
    if type(value) is not dict:
        raise Malformed("not a JSON object")
    return value


def read_stamp(message: dict[str, Any]) -> float:
    """Return the timestamp of a message, s. Raises Malformed if the timestamp is missing or not a finite number."""
    if "stamp" not in message:
        raise Malformed("stamp is missing")
    (stamp,) = read_numbers([message["stamp"]], "stamp")
    if not math.isfinite(stamp):
        raise Malformed("stamp is not a finite number")
    return stamp


def add_frame(frame: dict[str, Any], place: str, collector: BoxCollector) -> bool:
    """Add a frame with its boxes to `collector`. Return the value of its key "whole", which is False if the key is missing.

    "whole" is True if the image edge cuts no box off. A label is text, or an integer, because detectors number their
    classes. A box with another label is invalid. place: the file and line. Raises Malformed if the frame is invalid.
    """
    stamp = read_stamp(frame)
    boxes = _list(frame, "boxes")
    if len(boxes) > MAX_BOXES:
        raise Malformed(f"more than {MAX_BOXES} boxes")
    if any(type(box) is not list for box in boxes):
        raise Malformed("boxes must hold lists x1, y1, x2, y2")
    boxes = [read_numbers(box, "a box") for box in boxes]
    labels = [str(label) if type(label) in (str, int) else NO_LABEL for label in _list(frame, "labels")]
    scores = read_numbers(_list(frame, "scores"), "scores")
    unknown = [None] * len(boxes)
    depths = [_depth(depth) for depth in _list(frame, "depths", unknown)]
    track_ids = [_track_id(track_id) for track_id in _list(frame, "track_ids", unknown)]
    corners = [_corners(four) for four in _list(frame, "corners", unknown)]
    features = [_features(vector) for vector in _list(frame, "features", unknown)]
    if any(len(box) != 4 for box in boxes):
        raise Malformed("a box is not 4 numbers")
    if not len(boxes) == len(labels) == len(scores) == len(depths) == len(track_ids):
        raise Malformed("boxes, labels, scores, depths and track_ids differ in length")
    if len(corners) != len(boxes):
        raise Malformed("boxes and corners differ in length")
    if len(features) != len(boxes):
        raise Malformed("boxes and features differ in length")
    whole = frame.get("whole", False)
    if type(whole) is not bool:
        raise Malformed("whole is neither true nor false")
    collector.add_frame(stamp, place)
    columns = (boxes, labels, scores, depths, track_ids, corners, features)
    for box, label, score, depth, track_id, four, vector in zip(*columns, strict=True):
        collector.add_box(box, label, score, place, depth, track_id, four, vector)
    return whole


def _list(frame: dict[str, Any], name: str, default: list[None] | None = None) -> list[Any]:
    value = frame.get(name, default)
    if type(value) is not list:
        raise Malformed(f"{name} is missing or not a list")
    return value


def read_numbers(value: Any, name: str) -> list[float]:
    """Return a list of numbers as floats. Raises Malformed for other content."""
    if type(value) is not list or not all(type(item) in (int, float) for item in value):
        raise Malformed(f"{name} must hold numbers only")
    try:
        return [float(item) for item in value]
    except OverflowError as error:
        raise Malformed(f"{name} holds an integer beyond the range of floats") from error


def _depth(value: Any) -> float:
    if value is None:
        return math.nan
    (depth,) = read_numbers([value], "depths")
    return 0.0 if math.isnan(depth) else depth  # A NaN in the file is counted as an invalid depth, like zero.


def _corners(value: Any) -> list[list[float]] | None:
    if value is None:
        return None
    if type(value) is not list or len(value) != 4:
        raise Malformed("corners must hold four points x, y each, and null only")
    corners = [read_numbers(point, "a corner") for point in value]
    if any(len(point) != 2 for point in corners):
        raise Malformed("a corner is not 2 numbers")
    return corners


def _features(value: Any) -> list[float] | None:
    if value is None:
        return None
    return read_numbers(value, "features")


def _track_id(value: Any) -> int:
    if value is None:
        return -1
    if type(value) is not int or abs(value) >= 2**63:
        raise Malformed("track_ids must hold integers and null only")
    return max(value, -1)
