"""The settings of the CNN detector."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Device, Finite, Positive, Section, Share

Layout = Literal["ssd", "yolov8", "yolov5", "end_to_end", "yolox", "yolox_decoded", "detr"]
Role = Literal["boxes", "labels", "scores", "logits", "predictions"]
Resize = Literal["letterbox", "corner", "stretch", "none"]
Colour = Literal["rgb", "bgr"]
BoxForm = Literal["xyxy", "yxyx", "cxcywh"]
BoxUnits = Literal["pixels", "fractions"]
Activation = Literal["none", "sigmoid", "softmax"]


class Detector(Section):
    """The CNN detector, an ONNX model, that finds the boxes in a log's images. What is null is taken from the model: its
    metadata, the shapes of its outputs, the habits of its family."""

    layout: Layout | None = None
    """what the outputs are. ssd: boxes, labels, scores (SSD, torchvision, TensorFlow; boxes and scores may be one output).
    yolov8: box and classes (v8, v11, v12). yolov5: box, objectness and classes (v5, v7). end_to_end: corners, score, class
    (v10, v26). yolox: the raw grid; yolox_decoded: exported with the decoding inside. detr: boxes and logits."""
    outputs: dict[Role, str] | None = None
    """the name of the output that holds each role: boxes, labels and scores (ssd), boxes and logits (detr), predictions (the
    others)."""
    names: Annotated[tuple[str, ...], Field(min_length=1)] | str | None = None
    """the classes in the model's order: a list, a file (one a line, or YAML with `names`; beside the settings or the model),
    coco (80) or coco91 (numbered with its gaps)."""
    first_label: Annotated[int, Field(ge=0)] | None = None
    """the number that the model gives to the first name: 1 where 0 is the background and the names leave it out."""
    classes: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """the classes that count; null: all."""
    min_score: Share = 0.25
    """score below which a box is not taken."""
    iou: Share = 0.5
    """overlap (intersection over union) above which the less sure of two boxes of one class is dropped (see nms)."""
    nms: bool | None = None
    """whether overlapping boxes are dropped; null: where the family needs it, which is every YOLO except end_to_end."""
    max_boxes: Annotated[int, Field(ge=1)] = 300
    """boxes of an image at the most; the surest are kept."""
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    """width and height, px, that an image is fitted into, for models that take any."""
    resize: Resize | None = None
    """how an image is fitted: letterbox keeps its shape and pads all round, corner pads right and below, stretch changes its
    shape, none leaves it as it is."""
    pad: Annotated[int, Field(ge=0, le=255)] | None = None
    """the grey that is padded with; null: 114."""
    colour: Colour | None = None
    """the order of the channels."""
    divide_by: Positive | None = None
    """values of 0 to 255 are divided by it, then by mean and std: (value / divide_by - mean) / std."""
    mean: tuple[Finite, Finite, Finite] | None = None
    """for each channel, in the network's order."""
    std: tuple[Positive, Positive, Positive] | None = None
    """for each channel."""
    box_form: BoxForm | None = None
    """two corners, or centre and size."""
    box_units: BoxUnits | None = None
    """pixels or fractions of the network's input."""
    activation: Activation | None = None
    """what makes scores of the outputs. After softmax the last class is "nothing"."""
    device: Device = "auto"
    """auto: CUDA where this onnxruntime has it, else the CPU."""
    threads: Annotated[int, Field(ge=0)] = 0
    """threads of onnxruntime on the CPU; 0: one for each core."""
    batch: Annotated[int, Field(ge=1)] = 1
    """images at a time, for models that take any number."""
