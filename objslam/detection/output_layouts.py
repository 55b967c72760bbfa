"""Recognise the layout of a model's outputs. The evidence is the shapes of the outputs for one image, and the metadata."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from objslam import config
from objslam.config.detector import Layout, Role
from objslam.core.arrays import Array
from objslam.errors import ConfigError, DetectorError

STRIDES = (8, 16, 32)  # The strides in px of the three grids on which most YOLO models predict.
_FEW = 1000  # The largest number of boxes from a network that selects its boxes itself. A grid has thousands of boxes.
_ROLES: dict[Layout, tuple[frozenset[Role], ...]] = {
    "ssd": (frozenset({"boxes", "labels", "scores"}), frozenset({"boxes", "labels"})),
    "detr": (frozenset({"boxes", "logits"}), frozenset({"predictions"})),
}
_SINGLE: tuple[frozenset[Role], ...] = (frozenset({"predictions"}),)

Roles = Mapping[Role, str]
"""The names of a model's outputs by their roles. A role is, for example, `boxes`."""


@dataclass(frozen=True)
class Output:
    """One output of a model for one image: its name and its values."""

    name: str
    values: Array

    def __str__(self) -> str:
        return f"{self.name} {list(self.values.shape)} {self.values.dtype}"


@dataclass(frozen=True)
class Facts:
    """The facts that tell layouts with similar outputs apart. height, width: the size of the input, px. classes: the number
    of class names, or None if it is unknown."""

    height: int
    width: int
    classes: int | None
    metadata: Mapping[str, str]

    @property
    def ultralytics_detr(self) -> bool:
        """Whether the metadata describes a DETR model of Ultralytics. Such a model has one output. Up to version 8.3, the
        output has all class scores of each box. Later versions add the metadata key `head`, and their output has only the
        best score and class of each box."""
        return "detr" in self.metadata.get("description", "").lower()


def recognise(outputs: Sequence[Output], settings: config.Detector, facts: Facts, model: Path) -> tuple[Layout, Roles]:
    """Return the layout and the output name of each role. The settings override the recognition. Raises ConfigError if the
    settings name a missing output, or roles that form no layout. Raises DetectorError if no layout fits the outputs. The
    message of this error lists the outputs and says how to describe them."""
    layout = settings.layout
    roles: Roles | None = settings.outputs
    if roles is not None:
        named = _named(outputs, roles, model)
        layout = layout or _by_roles(named, facts)
        if layout is not None and frozenset(named) not in (forms := _ROLES.get(layout, _SINGLE)):
            allowed = " or ".join(", ".join(sorted(form)) for form in forms)
            message = f"detector.outputs names {', '.join(sorted(named))}, but the layout {layout} has {allowed}"
            raise ConfigError(message, where=str(model))
    elif layout is not None:
        roles = _roles(layout, outputs)
    else:
        layout, roles = _tell(outputs, facts)
    if layout is not None and roles is not None:
        return layout, roles
    saw = "; ".join(map(str, outputs))
    what = "no layout that is known" if settings.layout is None else f"not the layout {settings.layout}"
    raise DetectorError(
        f"its outputs fit {what}: {saw}",
        where=str(model),
        hint=f"set detector.layout to one of {', '.join(get_args(Layout))}, and detector.outputs to "
        "{boxes: NAME, labels: NAME, scores: NAME}, {boxes: NAME, logits: NAME} or {predictions: NAME}"
        + ("; or name its classes with --names FILE, whose number shows the layout" if facts.classes is None else ""),
    )


def rows_are_boxes(values: Array, classes: int | None) -> bool:
    """Return whether each row of the predictions (..., A, B) is a box. If False, each column is a box, as in YOLOv8.

    classes: the number of class names, or None if it is unknown.
    """
    rows, columns = values.shape[-2:]
    if classes is not None and (rows == 4 + classes) != (columns == 4 + classes):
        return bool(columns == 4 + classes)
    return bool(rows > columns)


def count_classes(layout: Layout, named: Mapping[Role, Array], facts: Facts) -> int | None:
    """Return the number of class scores that the outputs have for each box, or None if they have class numbers only."""
    if layout in ("ssd", "end_to_end"):
        return None
    if "logits" in named:
        return int(named["logits"].shape[-1])
    values = named["predictions"]
    if layout == "yolov8":
        return int(values.shape[-1 if rows_are_boxes(values, facts.classes) else -2]) - 4
    return int(values.shape[-1]) - (4 if layout == "detr" else 5)


def _tell(outputs: Sequence[Output], facts: Facts) -> tuple[Layout | None, Roles | None]:
    ssd, detr, single = _ssd_roles(outputs), _detr_roles(outputs), _single(outputs)
    if ssd is not None:
        return "ssd", ssd
    if detr is not None and all(o.values.shape[-2] <= _FEW for o in outputs if o.name in detr.values()):
        return "detr", detr
    return (None, None) if single is None else (_tell_single(single, facts), {"predictions": single.name})


def _roles(layout: Layout, outputs: Sequence[Output]) -> Roles | None:
    if layout == "ssd":
        return _ssd_roles(outputs)
    single, detr = _single(outputs), _detr_roles(outputs) if layout == "detr" else None
    return detr or (None if single is None else {"predictions": single.name})


def _ssd_roles(outputs: Sequence[Output]) -> Roles | None:
    for boxes in outputs:
        shape = boxes.values.shape
        if len(shape) not in (2, 3) or shape[-1] not in (4, 5):
            continue
        columns = [o for o in outputs if o is not boxes and o.values.shape in (shape[:-1], (*shape[:-1], 1))]
        whole = [o for o in columns if o.values.dtype.kind in "iu"]
        labels = _named_so(whole or columns, "label", "class") if len(whole) != 1 else whole
        scores = [o for o in columns if o not in labels and o.values.dtype.kind == "f"]
        scores = _named_so(scores, "score", "conf") if len(scores) > 1 else scores
        if len(labels) == 1 and shape[-1] == 4 and len(scores) == 1:
            return {"boxes": boxes.name, "labels": labels[0].name, "scores": scores[0].name}
        if len(labels) == 1 and shape[-1] == 5 and not scores:
            return {"boxes": boxes.name, "labels": labels[0].name}
    return None


def _detr_roles(outputs: Sequence[Output]) -> Roles | None:
    lists = [o for o in outputs if o.values.ndim in (2, 3) and o.values.dtype.kind == "f"]
    boxes = [o for o in lists if o.values.shape[-1] == 4]
    if len(boxes) > 1:
        boxes = _named_so(boxes, "box", "det")
    if len(boxes) != 1:
        return None
    beside = [o for o in lists if o is not boxes[0] and o.values.shape[:-1] == boxes[0].values.shape[:-1]]
    return {"boxes": boxes[0].name, "logits": beside[0].name} if len(beside) == 1 else None


def _single(outputs: Sequence[Output]) -> Output | None:
    """Return the output with predictions. Return None if no output or several outputs have predictions, or if another output
    has a row for each box. Other outputs, such as masks and raw heads, are ignored."""
    lists = [o for o in outputs if o.values.dtype.kind == "f" and (_is_numbered(o) or _is_list(o))]
    if len(lists) != 1:
        return None
    beside = [o for o in outputs if o is not lists[0] and o.values.shape[:2] == lists[0].values.shape[:2]]
    return None if beside else lists[0]


def _is_list(output: Output) -> bool:
    return output.values.ndim == 3 and output.values.shape[-1] >= 5


def _is_numbered(output: Output) -> bool:
    return output.values.ndim == 2 and output.values.shape[-1] == 7  # a row of YOLOv7 begins with the image number


def _tell_single(output: Output, facts: Facts) -> Layout | None:
    if _is_numbered(output):
        return "end_to_end"
    (rows, columns), classes = output.values.shape[-2:], facts.classes
    cells = sum(-(-facts.height // stride) * -(-facts.width // stride) for stride in STRIDES)
    few = rows <= _FEW and rows not in (cells, 3 * cells)
    if few and facts.ultralytics_detr:
        return "end_to_end" if columns == 6 and (classes != 2 or "head" in facts.metadata) else "detr"
    if facts.metadata.get("end2end") == "True" or (few and columns == 6):
        return "end_to_end"
    if columns == cells:
        return "yolov8"
    if rows == 3 * cells:
        return "yolov5"
    if rows == cells and (classes is None or columns != 4 + classes):
        # Raw offsets of box centres are a few cells. Decoded centres in px are spread over the image.
        if np.median(np.abs(output.values[..., :2])) < STRIDES[0]:
            return "yolox"
        # YOLOv6 has an objectness of 1 for every box.
        return "yolov5" if (output.values[..., 4] == 1).all() else "yolox_decoded"
    if classes is not None and 4 + classes in (rows, columns):
        return "detr" if few and columns == 4 + classes else "yolov8"
    if classes is not None and columns == 5 + classes:
        return "yolov5"
    if max(rows, columns) > _FEW:  # a grid with more strides or anchors
        return "yolov8" if columns > rows else "yolov5"
    return None


def _by_roles(named: Mapping[Role, Output], facts: Facts) -> Layout | None:
    if "predictions" in named:
        return _tell_single(named["predictions"], facts) if _is_list(named["predictions"]) else None
    return "detr" if "logits" in named else "ssd"


def _named(outputs: Sequence[Output], names: Roles, model: Path) -> dict[Role, Output]:
    by_name = {output.name: output for output in outputs}
    for name in names.values():
        if name not in by_name:
            message = f"detector.outputs: the model has no output {name!r}"
            raise ConfigError(message, where=str(model), hint=f"it has {'; '.join(map(str, outputs))}")
    return {role: by_name[name] for role, name in names.items()}


def _named_so(outputs: Sequence[Output], *words: str) -> list[Output]:
    return [output for output in outputs if any(word in output.name.lower() for word in words)]
