"""The recipe of a model: everything between an image and its boxes but the network itself."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from objslam.config import Activation, BoxForm, BoxUnits, Colour, Layout, Resize
from objslam.detection.output_layouts import Roles

Three = tuple[float, float, float]
PLAIN: tuple[Three, Three] = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
IMAGENET: tuple[Three, Three] = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Habits:
    """What the models of a family have in common, unless the settings or the model say otherwise.

    box_units None: the values must tell. normalise: mean and std of the channels, after the division.
    """

    resize: Resize
    colour: Colour
    divide_by: float
    box_form: BoxForm
    box_units: BoxUnits | None
    nms: bool
    activation: Activation = "none"
    normalise: tuple[Three, Three] = PLAIN


_YOLO = Habits("letterbox", "rgb", 255.0, "cxcywh", "pixels", nms=True)
_YOLOX = Habits("corner", "bgr", 1.0, "cxcywh", "pixels", nms=True)
HABITS: dict[Layout, Habits] = {
    "ssd": Habits("stretch", "rgb", 255.0, "xyxy", None, nms=False),
    "yolov8": _YOLO,
    "yolov5": _YOLO,
    "end_to_end": Habits("letterbox", "rgb", 255.0, "xyxy", "pixels", nms=False),
    "yolox": _YOLOX,
    "yolox_decoded": _YOLOX,
    "detr": Habits("stretch", "rgb", 255.0, "cxcywh", "fractions", False, "sigmoid", IMAGENET),
}


@dataclass(frozen=True)
class InputSize:
    """The network's input, px; along a free axis (one that the model leaves open) the most of it.

    stride: what a side of an input that shrinks to its image must be a multiple of.
    """

    width: int
    height: int
    free_width: bool
    free_height: bool
    stride: int


@dataclass(frozen=True)
class Recipe:
    """How images go in and boxes come out: the detector settings, with nothing left open.

    names: of the classes, empty where nobody knows them. first_label: the number that the model gives to the first. taken:
    the classes that count, by their place in names (by their number without names), None for all. channels: of class scores.
    row_boxes: predictions have a box a row. box_units None: the values tell.
    """

    layout: Layout
    outputs: Roles
    size: InputSize
    resize: Resize
    pad: int
    colour: Colour
    divide_by: float
    mean: Three
    std: Three
    names: tuple[str, ...]
    first_label: int
    taken: tuple[int, ...] | None
    channels: int | None
    row_boxes: bool
    box_form: BoxForm
    box_units: BoxUnits | None
    activation: Activation
    nms: bool
    min_score: float
    iou: float
    max_boxes: int

    def as_text(self) -> str:
        """All of it as text, the same for the same recipe."""
        return json.dumps(asdict(self), sort_keys=True)
