"""The recipe of a detector model: how an image becomes the input of the network, and how its outputs become boxes."""

import json
from dataclasses import asdict, dataclass

from objslam.config.detector import Activation, BoxForm, BoxUnits, Colour, Layout, Resize
from objslam.detection.output_layouts import Roles

Three = tuple[float, float, float]
NO_MEAN: Three = (0.0, 0.0, 0.0)
UNIT_STD: Three = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Habits:
    """The properties that models of a layout usually have. The settings and the model's own description override them. The
    fields are explained in `config.detector.Detector`."""

    resize: Resize
    colour: Colour
    divide_by: float
    box_form: BoxForm
    box_units: BoxUnits | None  # The units of boxes. If None, the values of the boxes show the units.
    nms: bool
    activation: Activation = "none"
    mean: Three = NO_MEAN  # The mean of each channel after the division.
    std: Three = UNIT_STD  # The standard deviation of each channel after the division.


_YOLO = Habits("letterbox", "rgb", 255.0, "cxcywh", "pixels", nms=True)
_YOLOX = Habits("corner", "bgr", 1.0, "cxcywh", "pixels", nms=True)
IMAGENET: tuple[Three, Three] = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""The mean and the standard deviation of the channels of ImageNet, red first."""
HABITS: dict[Layout, Habits] = {
    "ssd": Habits("stretch", "rgb", 255.0, "xyxy", None, nms=False),
    "yolov8": _YOLO,
    "yolov5": _YOLO,
    "end_to_end": Habits("letterbox", "rgb", 255.0, "xyxy", "pixels", nms=False),
    "yolox": _YOLOX,
    "yolox_decoded": _YOLOX,
    "detr": Habits("stretch", "rgb", 255.0, "cxcywh", "fractions", False, "sigmoid", *IMAGENET),
}


@dataclass(frozen=True)
class InputSize:
    """The size of the network input, px. The length of a free side is its largest length. In a run, a free side has the
    length of the resized image, rounded up to a multiple of `stride`."""

    width: int
    height: int
    free_width: bool
    free_height: bool
    stride: int


@dataclass(frozen=True, kw_only=True)
class Recipe(Habits):
    """The detector settings of a model, with every value determined."""

    layout: Layout
    outputs: Roles
    size: InputSize
    pad: int
    names: tuple[str, ...]  # The class names. The tuple is empty if the names are unknown.
    first_label: int  # The class number that the model gives to the first name.
    taken: tuple[int, ...] | None  # The indices into names (or class numbers) of the classes to keep. None keeps all.
    channels: int | None  # The number of class scores that are read for a box. None if a box has only a class number.
    row_boxes: bool  # True if a row of the predictions is a box, False if a column is a box.
    min_score: float
    iou: float
    max_boxes: int

    def as_text(self) -> str:
        """Return the recipe as text. Equal recipes have equal texts."""
        return json.dumps(asdict(self), sort_keys=True)


@dataclass(frozen=True, kw_only=True)
class EncoderRecipe:
    """The encoder settings of a model, with every value determined. width, height: the size to which a crop is stretched,
    px."""

    colour: Colour
    divide_by: float
    mean: Three
    std: Three
    width: int
    height: int
    margin: float  # The margin that is added to a box on each side, as a share of the box's width or height.
    pad: int = 0  # A stretched crop has no padding.
