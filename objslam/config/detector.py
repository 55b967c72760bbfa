"""The settings of the CNN detector."""

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Count, Device, Finite, Names, Positive, Section, Share

Layout = Literal["ssd", "yolov8", "yolov5", "end_to_end", "yolox", "yolox_decoded", "detr"]
Role = Literal["boxes", "labels", "scores", "logits", "predictions"]
Resize = Literal["letterbox", "corner", "stretch", "none"]
Colour = Literal["rgb", "bgr"]
BoxForm = Literal["xyxy", "yxyx", "cxcywh"]
BoxUnits = Literal["pixels", "fractions"]
Activation = Literal["none", "sigmoid", "softmax"]


class Detector(Section):
    """Configure the ONNX model that detects boxes in the images of a log. If a setting is null, its value comes from the
    model's metadata, from the shapes of its outputs, or from its model family."""

    layout: Layout | None = None
    """Layout of the model outputs. ssd: boxes, labels and scores (SSD, torchvision, TensorFlow). Boxes and scores may be in
    one output. yolov8: box and class scores (v8, v11, v12). yolov5: box, objectness and class scores (v5, v7). end_to_end:
    corners, score and class (v10, v26). yolox: raw grid. yolox_decoded: grid that the exported model decodes. detr: boxes
    and logits."""
    outputs: dict[Role, str] | None = None
    """Name of the model output for each role. In ssd, the roles are boxes, labels and scores. If ssd has no output for
    scores, the fifth column of boxes has the scores. In detr, the roles are either boxes and logits, or predictions alone.
    In every other layout, the only role is predictions."""
    names: Annotated[tuple[str, ...], Field(min_length=1)] | str | None = None
    """Class names in the order of the model. It is a list, a file, coco (80 names) or coco91 (91 names with gaps). The file
    has one name per line, or is YAML or JSON with the key `names`. A relative path may start from the folder of the settings
    file, the working folder or the folder of the model."""
    first_label: Annotated[int, Field(ge=0)] | None = None
    """Class number that the model gives to the first name. It is 1 if class 0 is the background and the names omit the
    background."""
    classes: Annotated[Names, Field(min_length=1)] | None = None
    """Names of the classes to keep. null keeps all classes."""
    min_score: Share = 0.25
    """Lowest score of a box that is kept."""
    iou: Share = 0.5
    """Intersection over union of two boxes of one class above which non-maximum suppression drops the box with the lower
    score."""
    nms: bool | None = None
    """Apply non-maximum suppression. null applies it to every YOLO layout except end_to_end."""
    max_boxes: Count = 300
    """Maximum number of boxes per image, up to 1000. The boxes with the highest scores are kept."""
    size: tuple[Count, Count] | None = None
    """Width and height of the input in px, for a model that accepts any size."""
    resize: Resize | None = None
    """How an image is fitted into the input. letterbox keeps the aspect ratio and pads all sides. corner keeps the aspect
    ratio and pads right and bottom. stretch changes the aspect ratio. none keeps the image size."""
    pad: Annotated[int, Field(ge=0, le=255)] | None = None
    """Grey value of the padding. null uses 114."""
    colour: Colour | None = None
    """Order of the colour channels of the input."""
    divide_by: Positive | None = None
    """Divisor of the pixel values (0 to 255). The input is (value / divide_by - mean) / std."""
    mean: tuple[Finite, Finite, Finite] | None = None
    """Mean of each channel, in the channel order of the input."""
    std: tuple[Positive, Positive, Positive] | None = None
    """Standard deviation of each channel, in the channel order of the input."""
    box_form: BoxForm | None = None
    """Coordinates of a box in the outputs: two corners, or centre and size."""
    box_units: BoxUnits | None = None
    """Units of a box in the outputs: pixels or fractions of the input size."""
    activation: Activation | None = None
    """Function that turns outputs into scores. With softmax, the last class means "no object"."""
    device: Device = "auto"
    """Device of the model. auto uses CUDA if onnxruntime supports CUDA, else the CPU."""
    threads: Annotated[int, Field(ge=0)] = 0
    """Number of onnxruntime threads on the CPU. 0 uses one thread per core."""
    batch: Count = 1
    """Number of images per batch, for a model that accepts any batch size."""
