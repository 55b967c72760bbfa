"""Decode the outputs for one image to boxes. Each layout has its own function."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from objslam.config.detector import Layout, Role
from objslam.core.arrays import Array, Floats, Ints
from objslam.detection.output_layouts import STRIDES
from objslam.detection.recipe import Recipe
from objslam.errors import DetectorError

_FRACTION = 1.5  # The largest absolute coordinate of boxes in fractions of the input. Boxes in px are far larger.
_CANDIDATES = 1000
"""The largest number of boxes that are kept for non-maximum suppression. The time of the suppression grows with the square
of this number."""
_Outputs = Mapping[Role, Array]


@dataclass(frozen=True)
class Candidates:
    """The boxes (N, 4) that one image may have, with scores (N,). label: (N,) class numbers, or indices into the names."""

    boxes: Floats
    scores: Floats
    label: Ints


def decode(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    """Decode the boxes of one image, and return those that the settings keep, the highest score first. A box is x1, y1, x2,
    y2 in px of the input. A label is an index into the names, or a class number if there are no names. outputs: the outputs
    without a batch axis. width, height: the size of the input, px. Raises DetectorError if a score is clearly above 1, a
    class has no name, or a class number is impossible."""
    found = _DECODERS[recipe.layout](recipe, outputs, width, height)
    boxes, scores = _corners(recipe, found.boxes, width, height), found.scores
    if len(scores) and scores.max() > 1.001:
        hint = "set detector.activation to sigmoid or softmax"
        raise DetectorError(f"scores of up to {scores.max():g} are no probabilities", hint=hint)
    label = _name_indices(recipe, found.label)
    keep = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1) & (label >= 0)
    if recipe.taken is not None:
        keep &= np.isin(label, recipe.taken)
    boxes, scores, label = boxes[keep], np.minimum(scores[keep], 1.0), label[keep]
    best = np.argsort(-scores, kind="stable")[:_CANDIDATES]
    if recipe.nms:
        best = best[suppress(boxes[best], scores[best], label[best], recipe.iou)]
    best = best[: recipe.max_boxes]
    return Candidates(boxes[best], scores[best], label[best])


def suppress(boxes: Floats, scores: Floats, label: Ints, iou: float) -> Ints:
    """Return the indices of the boxes (N, 4) that non-maximum suppression keeps, the best first. The suppression removes a
    box whose IoU with a better box of the same label is above `iou`. boxes: x1, y1, x2, y2, px."""
    import cv2

    if len(boxes) == 0:
        return np.zeros(0, dtype=np.int64)
    # OpenCV keeps labels apart by offsets of the largest coordinate, so no coordinate may be negative.
    boxes = boxes - np.tile(boxes.reshape(-1, 2).min(axis=0), 2)
    sized = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(sized, scores.astype(np.float32), label.astype(np.int32), -1.0, iou)  # type: ignore[arg-type]
    return np.asarray(kept, dtype=np.int64).reshape(-1)


def _ssd(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    boxes = outputs["boxes"]
    scores = _probability(outputs["scores"].reshape(-1) if "scores" in outputs else boxes[:, 4], recipe)
    keep = np.flatnonzero(scores >= recipe.min_score)
    return _candidates(boxes[keep, :4], scores[keep], outputs["labels"].reshape(-1)[keep])


def _end_to_end(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    rows = outputs["predictions"]
    if rows.shape[1] == 7:  # a row of YOLOv7 is image number, box, class, score
        rows = rows[:, [1, 2, 3, 4, 6, 5]]
    _check_classes(rows[:, 5])
    scores = _probability(rows[:, 4], recipe)
    keep = np.flatnonzero(scores >= recipe.min_score)
    return _candidates(rows[keep, :4], scores[keep], rows[keep, 5])


def _check_classes(values: Array) -> None:
    """Raise DetectorError if a class number is impossible, because the column then does not hold classes.

    values: (N,) the class numbers of all rows, also of rows with a low score. A row without a box may have -1 or a number
    that is not finite.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    wrong = (known != np.rint(known)) | (known < -1)
    if wrong.any():
        hint = "the outputs are not in the layout end_to_end: set detector.layout, such as yolov8"
        raise DetectorError(f"the model gives class {known[wrong][0]:g}, which is no number of a class", hint=hint)


def _yolov8(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    rows = outputs["predictions"] if recipe.row_boxes else outputs["predictions"].T
    return _best_class(recipe, rows[:, :4], rows[:, 4:])


def _yolov5(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    rows = _likely(recipe, outputs["predictions"])[0]
    return _best_class(recipe, rows[:, :4], rows[:, 5:], rows[:, 4])


def _yolox(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    rows, likely = _likely(recipe, outputs["predictions"])
    grids = [np.indices((-(-height // stride), -(-width // stride))).reshape(2, -1) for stride in STRIDES]
    cells = np.concatenate(grids, axis=1)[::-1].T.astype(np.float64)  # (N, 2) corners of the cells, by grid, then by row
    strides = np.repeat(STRIDES, [grid.shape[1] for grid in grids]).astype(np.float64)
    if len(strides) != len(outputs["predictions"]):
        count = len(outputs["predictions"])
        message = f"{count} predictions, but the grids of an input of {width}x{height} have {len(strides)}"
        raise DetectorError(message, hint="detector.layout yolox needs strides of 8, 16 and 32")
    cells, strides, raw = cells[likely], strides[likely, None], rows[:, :4].astype(np.float64)
    with np.errstate(over="ignore"):  # decode drops infinite boxes
        boxes = np.concatenate([(raw[:, :2] + cells) * strides, np.exp(raw[:, 2:]) * strides], axis=1)
    return _best_class(recipe, boxes, rows[:, 5:], rows[:, 4])


def _detr(recipe: Recipe, outputs: _Outputs, width: int, height: int) -> Candidates:
    if "predictions" in outputs:
        rows = outputs["predictions"]
        return _best_class(recipe, rows[:, :4], rows[:, 4:])
    return _best_class(recipe, outputs["boxes"], outputs["logits"])


_DECODERS: dict[Layout, Callable[[Recipe, _Outputs, int, int], Candidates]] = {
    "ssd": _ssd,
    "yolov8": _yolov8,
    "yolov5": _yolov5,
    "end_to_end": _end_to_end,
    "yolox": _yolox,
    "yolox_decoded": _yolov5,
    "detr": _detr,
}


def _likely(recipe: Recipe, rows: Array) -> tuple[Array, Ints]:
    """Return the rows whose objectness (column 4) is at least `min_score`, and their indices. The other rows give no box."""
    likely = np.flatnonzero(_probability(rows[:, 4], recipe) >= recipe.min_score)
    return rows[likely], likely


def _best_class(recipe: Recipe, boxes: Array, values: Array, objectness: Array | None = None) -> Candidates:
    """Return the boxes whose best class has a score of at least `min_score`. values: (N, C) the outputs for the classes.
    objectness: (N,) the factors of the scores, or None."""
    values = values[:, : recipe.channels]
    if recipe.activation == "softmax":
        weights = np.exp(values - values.max(axis=1, keepdims=True))
        values = (weights / weights.sum(axis=1, keepdims=True))[:, :-1]
    scores = values.max(axis=1)
    if recipe.activation == "sigmoid":
        scores = _probability(scores, recipe)
    if objectness is not None:
        scores = scores * _probability(objectness, recipe)
    keep = np.flatnonzero(scores >= recipe.min_score)
    return _candidates(boxes[keep], scores[keep], values[keep].argmax(axis=1))


def _candidates(boxes: Array, scores: Array, label: Array) -> Candidates:
    numbers = np.where(np.isfinite(label), label, -1).astype(np.float64)
    return Candidates(boxes.astype(np.float64), scores.astype(np.float64), np.rint(numbers).astype(np.int64))


def _probability(values: Array, recipe: Recipe) -> Array:
    if recipe.activation != "sigmoid":
        return values
    return 0.5 * (1.0 + np.tanh(0.5 * values.astype(np.float64)))  # the logistic function without overflow


def _corners(recipe: Recipe, boxes: Floats, width: int, height: int) -> Floats:
    """Convert boxes (N, 4) from the form and units of the recipe to x1, y1, x2, y2 in px of the input."""
    if recipe.box_form == "cxcywh":
        centre, half = boxes[:, :2], boxes[:, 2:] / 2
        boxes = np.concatenate([centre - half, centre + half], axis=1)
    elif recipe.box_form == "yxyx":
        boxes = boxes[:, [1, 0, 3, 2]]
    fractions = recipe.box_units == "fractions"
    if recipe.box_units is None:
        fractions = bool((np.abs(boxes) <= _FRACTION).all())
    return boxes * np.array([width, height] * 2) if fractions else boxes


def _name_indices(recipe: Recipe, label: Ints) -> Ints:
    """Return the index into the names for each class number. Class numbers below the first name, such as the background, get
    -1. Raises DetectorError if a class has no name."""
    indices = label - recipe.first_label
    beyond = indices >= len(recipe.names)
    if recipe.names and beyond.any():
        message = f"the model gives class {label[beyond][0]}, but there are {len(recipe.names)} names"
        raise DetectorError(message, hint="set detector.names in the order of the model, or detector.first_label")
    return np.maximum(indices, -1)
