"""Which layout a model's outputs have, told from their shapes and the model's metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import get_args

import numpy as np

from objslam import config
from objslam.config import Layout, Role
from objslam.detection.network import Array
from objslam.errors import ConfigError, DetectorError

ROLES: dict[Layout, tuple[Role, ...]] = {
    "ssd": ("boxes", "labels", "scores"),
    "yolov8": ("predictions",),
    "yolov5": ("predictions",),
    "end_to_end": ("predictions",),
    "yolox": ("predictions",),
    "yolox_decoded": ("predictions",),
    "detr": ("boxes", "logits"),
}
STRIDES = (8, 16, 32)
_FEW = 1000  # boxes that a network gives after it has chosen among them; grids have thousands


@dataclass(frozen=True)
class Output:
    """One output of a run on one image: its name and values."""

    name: str
    values: Array

    def __str__(self) -> str:
        return f"{self.name} {list(self.values.shape)} {self.values.dtype}"


Roles = Mapping[Role, str]


@dataclass(frozen=True)
class Facts:
    """What helps to tell layouts apart: the input's size in px, the number of class names (None if unknown), metadata."""

    height: int
    width: int
    classes: int | None
    metadata: Mapping[str, str]

    @property
    def cells(self) -> int:
        """Cells of the three grids that most of the YOLOs predict on."""
        return sum(-(-self.height // stride) * -(-self.width // stride) for stride in STRIDES)


def recognise(
    outputs: Sequence[Output], settings: config.Detector, facts: Facts, model: Path
) -> tuple[Layout, Roles]:
    """The layout of the outputs and which of them has which role; what the settings say goes before what is told.

    ConfigError where the settings name outputs that are not there; DetectorError, with the outputs and how to describe them,
    where no layout fits.
    """
    layout = settings.layout
    if settings.outputs is not None:
        named = _named(outputs, settings.outputs, model)
        layout = layout or _by_roles(named, facts)
        if layout is None or not _complete(layout, named):
            wanted = "; ".join(f"{key}: {', '.join(roles)}" for key, roles in ROLES.items())
            message = f"detector.outputs has the roles {', '.join(named)}, which make no {layout or 'layout'}"
            raise ConfigError(message, where=str(model), hint=f"roles are {wanted}")
        return layout, {role: output.name for role, output in named.items()}
    for candidate in get_args(Layout) if layout is None else (layout,):
        roles = _match(candidate, outputs, facts, certain=layout is not None)
        if roles is not None:
            return candidate, roles
    saw = "; ".join(map(str, outputs))
    what = f"its outputs do not fit detector.layout {layout}" if layout else "its outputs fit no layout that is known"
    raise DetectorError(
        f"{what}: {saw}",
        where=str(model),
        hint=f"describe them: detector.layout is one of {', '.join(get_args(Layout))}, detector.outputs says which is which, "
        "such as {boxes: NAME, labels: NAME, scores: NAME}, {boxes: NAME, logits: NAME} or {predictions: NAME}",
    )


def rows_are_boxes(values: Array, facts: Facts) -> bool:
    """Whether predictions (1, A, B) have a box a row, as YOLOv8's do not."""
    rows, columns = values.shape[-2:]
    if facts.classes is not None and (rows == 4 + facts.classes) != (columns == 4 + facts.classes):
        return bool(columns == 4 + facts.classes)
    return bool(rows > columns)


def _match(layout: Layout, outputs: Sequence[Output], facts: Facts, *, certain: bool) -> Roles | None:
    """The roles of the outputs in this layout, None where it does not fit; `certain`: the settings say that it is this."""
    if layout == "ssd":
        return _match_ssd(outputs)
    single = _single(outputs)
    if layout == "detr":
        roles = _match_detr(outputs)
        if roles is None and single and (certain or _which(single, facts) == "detr"):
            return {"predictions": single.name}
        return roles
    return {"predictions": single.name} if single and (certain or _which(single, facts) == layout) else None


def _match_ssd(outputs: Sequence[Output]) -> Roles | None:
    for boxes in outputs:
        shape = boxes.values.shape
        if len(shape) not in (2, 3) or shape[-1] not in (4, 5):
            continue
        columns = [o for o in outputs if o is not boxes and _one_each(o.values, shape)]
        labels = [o for o in columns if o.values.dtype.kind in "iu"] or [o for o in columns if _says(o, "label", "class")]
        scores = [o for o in columns if o not in labels and o.values.dtype.kind == "f"]
        if len(labels) != 1:
            continue
        if shape[-1] == 4 and len(scores) == 1:
            return {"boxes": boxes.name, "labels": labels[0].name, "scores": scores[0].name}
        if shape[-1] == 5 and not scores:
            return {"boxes": boxes.name, "labels": labels[0].name}
    return None


def _one_each(values: Array, boxes: tuple[int, ...]) -> bool:
    """Whether the values are one for each of the boxes (B, N, 4) or (N, 4), perhaps with an axis of 1 at the end."""
    shape = values.shape
    return shape == boxes[:-1] or shape == (*boxes[:-1], 1) or (len(boxes) == 3 and boxes[0] == 1 and shape == boxes[1:2])


def _match_detr(outputs: Sequence[Output]) -> Roles | None:
    flat = [o for o in outputs if o.values.ndim in (2, 3) and o.values.dtype.kind == "f"]
    boxes = [o for o in flat if o.values.shape[-1] == 4]
    if len(boxes) > 1:
        boxes = [o for o in boxes if _says(o, "box", "det")]
    if len(boxes) != 1:
        return None
    same = [o for o in flat if o is not boxes[0] and o.values.shape[:-1] == boxes[0].values.shape[:-1]]
    if len(same) > 1:
        same = [o for o in same if _says(o, "logit", "label", "score", "class", "cls")]
    return {"boxes": boxes[0].name, "logits": same[0].name} if len(same) == 1 else None


def _single(outputs: Sequence[Output]) -> Output | None:
    """The one output with predictions; others may be there that are no list of boxes (masks, raw heads)."""
    flat = [o for o in outputs if o.values.dtype.kind == "f" and (_is_list(o.values) or _is_numbered(o.values))]
    return flat[0] if len(flat) == 1 else None


def _is_list(values: Array) -> bool:
    return values.ndim == 3 and min(values.shape[-2:]) >= 5 or (values.ndim == 3 and values.shape[-1] >= 6)


def _is_numbered(values: Array) -> bool:
    return values.ndim == 2 and values.shape[-1] == 7


def _which(output: Output, facts: Facts) -> Layout | None:
    values = output.values
    if _is_numbered(values):
        return "end_to_end"
    rows, columns = values.shape[-2:]
    cells, classes, told = facts.cells, facts.classes, facts.metadata
    grid = rows in (cells, 3 * cells)
    if rows <= _FEW and not grid and "detr" in told.get("description", "").lower():
        return "detr"
    if told.get("end2end") == "True" or (columns == 6 and rows <= _FEW and not grid):
        return "end_to_end"
    if columns == cells or rows == 4 + (classes or -4):
        return "yolov8"
    if rows == 3 * cells:
        return "yolov5"
    if rows == cells:
        return "yolov8" if columns == 4 + (classes or -4) else _yolox(values)
    if columns == 4 + (classes or -4):
        return "detr" if rows <= _FEW else "yolov8"
    if columns == 5 + (classes or -5):
        return "yolov5"
    if max(rows, columns) > max(_FEW, 5 * min(rows, columns)):  # other grids: more strides, more anchors
        return "yolov8" if columns > rows else "yolov5"
    return None


def _yolox(values: Array) -> Layout:
    """Raw offsets stay within a few cells; decoded centres, in pixels, are spread over the image."""
    if np.median(np.abs(values[..., :2])) < STRIDES[0]:
        return "yolox"
    return "yolov5" if (values[..., 4] == 1).all() else "yolox_decoded"  # YOLOv6 writes an objectness of 1 throughout


def _says(output: Output, *words: str) -> bool:
    return any(word in output.name.lower() for word in words)


def _named(outputs: Sequence[Output], names: Mapping[Role, str], model: Path) -> dict[Role, Output]:
    there = {output.name: output for output in outputs}
    missing = [name for name in names.values() if name not in there]
    if missing:
        message = f"detector.outputs: the model has no output {missing[0]!r}"
        raise ConfigError(message, where=str(model), hint=f"it has {'; '.join(map(str, outputs))}")
    return {role: there[name] for role, name in names.items()}


def _by_roles(named: Mapping[Role, Output], facts: Facts) -> Layout | None:
    if "predictions" in named:
        return _which(named["predictions"], facts)
    return "detr" if "logits" in named else "ssd"


def _complete(layout: Layout, named: Mapping[Role, Output]) -> bool:
    given = set(named)
    also = {"ssd": {"boxes", "labels"}, "detr": {"predictions"}}.get(layout)
    return given == set(ROLES[layout]) or given == also


def count_classes(layout: Layout, named: Mapping[Role, Array], facts: Facts) -> int | None:
    """How many classes the outputs have room for; None where the model only gives their numbers."""
    if layout in ("ssd", "end_to_end"):
        return None
    if "logits" in named:
        return int(named["logits"].shape[-1])
    values = named["predictions"]
    if layout == "yolov8":
        return int(values.shape[-1 if rows_are_boxes(values, facts) else -2]) - 4
    return int(values.shape[-1]) - (4 if layout == "detr" else 5)


__all__ = ["ROLES", "STRIDES", "Facts", "Output", "Roles", "count_classes", "prod", "recognise", "rows_are_boxes"]
