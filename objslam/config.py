"""The settings: nested, with a default for everything; YAML files and `--set key=value` change them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from objslam.errors import ConfigError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Device = Literal["auto", "cpu", "cuda"]
Loss = Literal["l1", "huber", "cauchy", "gnc"]
Layout = Literal["ssd", "yolov8", "yolov5", "end_to_end", "yolox", "yolox_decoded", "detr"]
Role = Literal["boxes", "labels", "scores", "logits", "predictions"]
Resize = Literal["letterbox", "corner", "stretch", "none"]
Colour = Literal["rgb", "bgr"]
BoxForm = Literal["xyxy", "yxyx", "cxcywh"]
BoxUnits = Literal["pixels", "fractions"]
Activation = Literal["none", "sigmoid", "softmax"]
Share = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Section(BaseModel):
    """A part of the settings: frozen, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


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
    """boxes that the network is less sure of are not taken."""
    iou: Share = 0.5
    """of two boxes of one class that overlap by more, the better stays (see nms)."""
    nms: bool | None = None
    """whether such boxes are dropped; null: where the family needs it, the YOLOs but end_to_end."""
    max_boxes: Annotated[int, Field(ge=1)] = 300
    """the best so many of an image are kept."""
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
    """of onnxruntime on the CPU; 0: as many as there are cores."""
    batch: Annotated[int, Field(ge=1)] = 1
    """images at a time, for models that take any number."""


class Poses(Section):
    """How poses are read off the log."""

    use: Literal["auto", "odometry", "localization"] = "auto"
    """which poses of a log that has both: auto takes the localisation, and in joint mode the odometry between its poses."""
    max_gap: Positive = 1.1
    """s; a frame in a longer gap of the path is dropped and counted."""


class RayNoise(Section):
    """From boxes to rays."""

    pixel_sigma: Positive = 3.0
    """px; one standard deviation of a box centre, per axis."""
    box_sigma: NotNegative = 0.05
    """share of a box's size (geometric mean of width and height) by which its centre wanders besides."""
    min_score: NotNegative = 0.0
    """boxes with a lower score are dropped and counted."""
    border: Annotated[float, Field(allow_inf_nan=False)] = 1.0
    """px; a box that comes this close to the image's edge is cut off there, its centre is not the object's: dropped and
    counted. A negative number keeps such boxes."""
    border_share: NotNegative = 0.07
    """share of a box's own width or height that counts as close to the edge as well: detectors let cut boxes end short of
    it."""


class Depth(Section):
    """The optional depth at a box, used as a range along its ray."""

    use: bool = True
    sigma: Positive = 0.03
    """m; the part of the noise that does not depend on the distance."""
    sigma_per_m: NotNegative = 0.02
    """m per m; the part that grows with it."""
    bias: NotNegative = 0.05
    """m; the error that all ranges of one object share (they end on its surface, or were calibrated a little long), which no
    number of them averages out."""


class Odometry(Section):
    """How far odometry drifts: standard deviations that grow with the square root of the way (a random walk)."""

    x_per_m: NotNegative = 0.02
    """m along the drive after 1 m of it."""
    y_per_m: NotNegative = 0.005
    """m sideways after 1 m; wheels hardly slip sideways, an omnidirectional base may need as much as for x."""
    xy_per_rad: NotNegative = 0.005
    """m after turning 1 rad on the spot."""
    yaw_per_m: NotNegative = 0.02
    """rad after 1 m of driving."""
    yaw_per_rad: NotNegative = 0.05
    """rad after turning 1 rad."""
    floor_xy: Positive = 1e-3
    """m a step; what remains when the robot stands."""
    floor_yaw: Positive = 1e-3
    """rad a step."""


class Planar(Section):
    """How planar a planar path is: a real floor is not perfect. Per step."""

    z: Positive = 1e-3
    """m."""
    tilt: Positive = 1e-3
    """rad, roll and pitch."""


class Localization(Section):
    """How good absolute poses are (standard deviation of each pose)."""

    xy: Positive = 0.02
    """m."""
    yaw: Positive = 0.005
    """rad."""


class AssociationSettings(Section):
    """Which ray belongs to which object."""

    method: Literal["auto", "global", "by_label"] = "auto"
    """by_label: every label is one object. global: several objects may share a label. auto: by_label where no frame has two
    boxes of one label and hardly a ray disagrees with the one object, else global."""
    hypotheses: Annotated[int, Field(ge=16)] = 1024
    """points tried at a time for each label, from pairs of rays."""
    gate: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """share of the right boxes that pass the gate on how far a ray may pass its object."""
    min_existence: Annotated[float, Field(ge=0, le=1)] = 0.5
    """objects that exist less likely than this, by where they were detected and where not, are dropped."""
    fuse_labels: bool = True
    """objects of different labels that are one thing become one object with several labels."""


class Triangulation(Section):
    """Objects from rays with known poses."""

    device: Device = "auto"
    consensus: bool = True
    """start from the best agreement of ray pairs, so that outliers do not move an object."""
    hypotheses: Annotated[int, Field(ge=1)] = 256
    """ray pairs tried for each object."""
    min_parallax_deg: NotNegative = 3.0
    """an object whose rays span less is unresolved."""
    max_rel_sigma: Positive = 0.5
    """an object whose position is less certain than this share of its distance is unresolved."""


class Fixed(Section):
    """Objects with the poses as they are."""

    loss: Loss = "l1"


class Joint(Section):
    """Poses and objects together."""

    loss: Loss = "huber"
    factor: Literal["bearing", "point_to_line"] = "bearing"
    """point_to_line is Eq. 1; with free poses it shrinks the map, since a smaller world has smaller distances."""
    min_parallax_deg: NotNegative = 8.0
    """a landmark enters the growing graph once its rays span this much."""
    prior_sigma: Positive = 20.0
    """m; a weak prior on each landmark that keeps the graph determined."""
    grow_step: Annotated[int, Field(ge=2)] = 60
    """keyframes added at a time when there is odometry alone."""
    explore_step: Annotated[int, Field(ge=1)] = 10
    """the same while it is not known which ray belongs to which object: short, for recognition needs good predictions."""
    max_rounds: Annotated[int, Field(ge=1)] = 6
    """association and solve take turns until nothing changes, this often at the most."""
    max_iterations: Annotated[int, Field(ge=1)] = 100


class Reconstruction(Section):
    """The surface of the room, from depth images fused at the solved poses."""

    use: bool = True
    """whether there is one where the log has depth images."""
    before: bool = False
    """also one at the poses as the log brought them, to compare."""
    cloud: bool = False
    """also its points alone, with normals, in a file of their own."""
    device: Device = "auto"
    voxel: Positive = 0.02
    """m; the size of a voxel."""
    truncation: Positive = 0.06
    """m; how far from a surface depths are averaged: more than they err, less than things are thick. At least 2 voxels."""
    max_depth: Positive = 4.0
    """m; depths beyond it are not used."""
    min_views: Annotated[int, Field(ge=1)] = 3
    """a surface counts once so many depth images saw it."""
    stride: Annotated[int, Field(ge=1)] = 1
    """every so many-th depth image is used."""
    max_frames: Annotated[int, Field(ge=1, le=65535)] = 1000
    """of more than that, evenly many are left out."""
    max_blocks: Annotated[int, Field(ge=2048)] = 80_000
    """the grid grows to so many blocks of 6^3 voxels, at 4.3 kB each."""


class Live(Section):
    """Mapping while the robot drives."""

    keyframe_distance: NotNegative = 0.01
    """m; a frame becomes a keyframe once its camera has moved so far since the last one,"""
    keyframe_angle_deg: NotNegative = 0.5
    """or turned so far, or shows a label that no keyframe since then has. Where it stands still, the first ten are taken."""
    max_keyframes: Annotated[int, Field(ge=50)] = 1500
    """when there are more, a quarter of the older ones is left out, with their boxes, and the odometry across them
    summed up: what memory and time an update take stays bounded."""
    max_lag: Positive = 0.35
    """s; frames that had to wait for longer are dropped and counted."""
    max_late: Positive = 2.0
    """s; how far behind the newest pose a frame's stamp may be."""
    max_frames_waiting: Annotated[int, Field(ge=1)] = 64
    """of more than that the oldest is dropped and counted."""
    max_speed: Positive = 5.0
    """m/s; odometry that moves faster, or turns faster than 4 times that in rad/s, has jumped: it is taken to have
    started anew where it was."""
    min_rays: Annotated[int, Field(ge=3)] = 5
    """boxes that must agree before an object enters the graph."""
    reassociate: Annotated[int, Field(ge=0)] = 6000
    """up to so many boxes, all are associated anew in the end, as offline does: a matter of seconds."""
    forget: Positive = 5.0
    """s; a few boxes that are not seen again for so long are left unexplained."""


class Output(Section):
    """What a run writes."""

    recording: bool = True
    images: Annotated[int, Field(ge=0)] = 1000
    """of each camera go into the recording, at the most, evenly spread; 0: none."""
    image_width: Annotated[int, Field(ge=16)] = 480
    """px; in the recording wider images are made smaller, by a whole number."""
    picture: bool = True


class Settings(Section):
    """All settings of a run."""

    mode: Literal["fixed", "joint"] = "fixed"
    seed: Annotated[int, Field(ge=0)] = 0
    detector: Detector = Detector()
    poses: Poses = Poses()
    rays: RayNoise = RayNoise()
    depth: Depth = Depth()
    odometry: Odometry = Odometry()
    planar: Planar = Planar()
    localization: Localization = Localization()
    association: AssociationSettings = AssociationSettings()
    triangulation: Triangulation = Triangulation()
    fixed: Fixed = Fixed()
    joint: Joint = Joint()
    live: Live = Live()
    reconstruction: Reconstruction = Reconstruction()
    output: Output = Output()


def load_settings(file: Path | None = None, overrides: tuple[str, ...] = ()) -> Settings:
    """Settings from defaults, a YAML file, then `key=value` overrides (dotted keys, YAML values), the later the stronger.

    ConfigError names the file or override, the key, and what is wrong with it.
    """
    data: dict[str, Any] = {}
    if file is not None:
        data = _read_yaml(file)
        _find_names(_validate(data, str(file)), data, file.parent)
    for text in overrides:
        key, sign, value = text.partition("=")
        if not sign or not key:
            raise ConfigError(f"--set {text!r} is not key=value", hint="for example --set joint.loss=cauchy")
        try:
            _put(data, key.strip().split("."), yaml.safe_load(value))
        except (yaml.YAMLError, ValueError) as error:  # PyYAML lets the ValueError of an impossible date through
            raise ConfigError(f"the value of --set {text!r} is not YAML") from error
        _validate(data, f"--set {text}")
    return _validate(data, "settings")


def dump_settings(settings: Settings) -> str:
    """The settings as YAML that `load_settings` reads back."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the settings: {error}", where=str(file)) from error
    except (yaml.YAMLError, ValueError) as error:  # as above
        mark = getattr(error, "problem_mark", None)
        where = f"{file}:{mark.line + 1}" if mark else str(file)
        raise ConfigError(f"not YAML: {getattr(error, 'problem', error)}", where=where) from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError("the settings must be a mapping of keys to values", where=str(file))
    return data


def _find_names(settings: Settings, data: dict[str, Any], folder: Path) -> None:
    """A names file that lies beside the settings file is meant, wherever the run is started."""
    names = settings.detector.names
    if isinstance(names, str) and is_file(folder / names):
        data["detector"]["names"] = str((folder / names).resolve())


def is_file(path: Path) -> bool:
    """Whether there is a file that can be looked at; no text that is no path at all is an error."""
    try:
        return path.is_file()
    except OSError:  # too long for a name, or in a folder that is closed to us
        return False


def _put(data: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        inner = data.setdefault(key, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"--set {'.'.join(keys)}: {key} has no keys below it")
        data = inner
    data[keys[-1]] = value


def _validate(data: dict[str, Any], where: str) -> Settings:
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            message = f"there is no setting {key}{_meant(key)}"
        else:
            message = f"{key}: {first['msg'][0].lower()}{first['msg'][1:]}, got {first['input']!r}"
        raise ConfigError(message, where=where, hint="`objslam config dump` shows every setting") from error


def _meant(key: str) -> str:
    """The setting that a mistyped key may stand for, as a question; nothing where none is like it."""
    import difflib

    def names(section: type[BaseModel], prefix: str) -> Iterator[str]:
        for name, of in section.model_fields.items():
            if isinstance(of.annotation, type) and issubclass(of.annotation, BaseModel):
                yield from names(of.annotation, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}"

    near = difflib.get_close_matches(key, list(names(Settings, "")), 1, 0.75)
    return f" (did you mean {near[0]}?)" if near else ""
