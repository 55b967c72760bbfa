"""Infer the recipe of a detector model. The settings override the model's own description, and the description overrides
the usual recipe of the layout."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from difflib import get_close_matches

from objslam import config
from objslam.config.detector import Layout, Role
from objslam.core.arrays import Array
from objslam.detection.class_names import default_names, is_background, names_from_metadata, names_from_settings
from objslam.detection.onnx_model import Network
from objslam.detection.output_layouts import Facts, Output, Roles, count_classes, recognise, rows_are_boxes
from objslam.detection.recipe import HABITS, NO_MEAN, UNIT_STD, Habits, InputSize, Recipe
from objslam.errors import ConfigError, DetectorError

DESCRIPTION = "objslam.detector"
"""The metadata key of a model's own description, which is JSON with keys of the `detector` settings."""
USER_ONLY = frozenset({"classes", "min_score", "iou", "max_boxes", "size", "device", "threads", "batch"})
"""The settings that no model may describe, because they depend on the user and on the computer."""
_SIZE = 640  # The width and height of an input of free size, px, if the settings and the metadata have no size.
_LARGEST = 8192  # The largest width or height, px, that is accepted from the metadata. The limit bounds memory.
_STRIDE = 32  # The stride of an input of free size, px, if the metadata has no stride.
_PAD = 114  # The grey value of the padding if the settings have no value.
_QUERIES = 300  # The least number of queries of newer DETR models. The original DETR and its close variants have 100.
_UNNAMED = "the model names no classes: they are numbered (--names FILE names them)"


def input_size(network: Network, settings: config.Detector) -> InputSize:
    """Return the size of the network input. A side that the model leaves free has the length in the settings, else the
    training size in the metadata, else 640 px. Raises ConfigError if the settings and the model differ."""
    image = network.image
    width, height = settings.size or _training_size(network.metadata) or (_SIZE, _SIZE)
    if settings.size is not None and (width, height) != (image.width or width, image.height or height):
        takes = f"{image.width or 'any'}x{image.height or 'any'}"
        raise ConfigError(f"detector.size is {width}x{height}, the model takes {takes}", where=str(network.path))
    stride = network.metadata.get("stride", "")
    return InputSize(
        width=image.width or width,
        height=image.height or height,
        free_width=image.width is None,
        free_height=image.height is None,
        stride=int(stride) if re.fullmatch("[1-9][0-9]{0,2}", stride) else _STRIDE,
    )


def settle(
    network: Network, settings: config.Detector, size: InputSize, outputs: Sequence[Output]
) -> tuple[Recipe, str | None]:
    """Return the recipe, inferred from the outputs for an input of this size, and a warning or None. The warning says that
    the class names are a guess or missing. Raises ConfigError or DetectorError if the layout, the task, the settings or the
    names do not fit."""
    task = network.metadata.get("task", "detect")
    if task in ("classify", "obb"):
        message = f"the model's task is {task}, which gives no axis-aligned boxes"
        raise DetectorError(message, where=str(network.path), hint="use a detection model")
    own_names = names_from_settings(settings.names, network.path)
    known = own_names or names_from_metadata(network.metadata.get("names"), network.path)
    facts = Facts(size.height, size.width, len(known) if known else None, network.metadata)
    layout, roles = recognise(outputs, settings, facts, network.path)
    values = {output.name: output.values for output in outputs}
    named = {role: values[name] for role, name in roles.items()}
    bytes_in = network.image.tensor.kind == "uint8"
    if bytes_in and not (settings.divide_by is None and settings.mean is None and settings.std is None):
        message = "the model takes bytes as they are, so detector.divide_by, mean and std cannot be set"
        raise ConfigError(message, where=str(network.path))
    habits = _habits(layout, roles, named, facts, free_size=size.free_width or size.free_height, bytes_in=bytes_in)
    if settings.size is not None and habits.resize == "none":
        habits = replace(habits, resize="stretch")
    given = {field.name: getattr(settings, field.name) for field in fields(Habits)}
    habits = replace(habits, **{name: value for name, value in given.items() if value is not None})
    softmax = habits.activation == "softmax"
    channels = count_classes(layout, named, facts)
    names, warning = _fit_names(network, known, channels, softmax=softmax, exact=own_names is not None)
    # Class 0 is the background in torchvision and TensorFlow.
    from_1 = layout == "ssd" and (network.image.batch == 0 or _is_tensorflow(roles))
    from_1 = from_1 and bool(names) and not is_background(names[0])
    recipe = Recipe(
        **vars(habits),
        layout=layout,
        outputs=dict(roles),
        size=size,
        pad=_PAD if settings.pad is None else settings.pad,
        names=names,
        first_label=int(from_1) if settings.first_label is None else settings.first_label,
        taken=_taken(settings.classes, names, network),
        channels=channels if channels is None or softmax else len(names),
        row_boxes=layout != "yolov8" or rows_are_boxes(named["predictions"], facts.classes),
        min_score=settings.min_score,
        iou=settings.iou,
        max_boxes=settings.max_boxes,
    )
    return recipe, warning


def _habits(
    layout: Layout, roles: Roles, named: Mapping[Role, Array], facts: Facts, *, free_size: bool, bytes_in: bool
) -> Habits:
    """Return the usual properties of models of a layout. Some families of models get other properties."""
    habits = HABITS[layout]
    if layout == "ssd" and free_size:
        habits = replace(habits, resize="none")  # An ssd model of free size resizes the image itself.
    if _is_tensorflow(roles):
        habits = replace(habits, box_form="yxyx", box_units="fractions")
    if layout == "end_to_end" and facts.ultralytics_detr:
        habits = replace(habits, resize="stretch", box_form="cxcywh", box_units="fractions")
    if layout == "detr" and "predictions" in named:  # RT-DETR exported by Ultralytics
        habits = replace(habits, activation="none", mean=NO_MEAN, std=UNIT_STD)
    elif layout == "detr":
        queries, classes = named["logits"].shape[-2:]
        old = queries < _QUERIES
        if classes == facts.classes + 1 if facts.classes is not None else old:
            habits = replace(habits, activation="softmax")
        if not old and roles["boxes"] != "dets":  # RT-DETR and its variants do not normalise. RF-DETR ("dets") does.
            habits = replace(habits, mean=NO_MEAN, std=UNIT_STD)
    return replace(habits, divide_by=1.0, mean=NO_MEAN, std=UNIT_STD) if bytes_in else habits


def _training_size(metadata: Mapping[str, str]) -> tuple[int, int] | None:
    try:
        height, width = json.loads(metadata.get("imgsz", "null"))
    except (ValueError, TypeError, RecursionError):
        return None
    return (width, height) if all(type(n) is int and 0 < n <= _LARGEST for n in (width, height)) else None


def _is_tensorflow(roles: Roles) -> bool:
    return roles.get("boxes", "").startswith("detection_boxes")


def _fit_names(
    network: Network, known: tuple[str, ...] | None, channels: int | None, *, softmax: bool, exact: bool
) -> tuple[tuple[str, ...], str | None]:
    """Return the class names, and a warning or None. The warning says that the names are a guess or missing. If the metadata
    has fewer names than the output has channels, the other channels are masks or key points.

    known: the names from the settings or the metadata. channels: the number of class scores per box. softmax: whether the
    last class means "no object". exact: whether the number of names must fit. Raises ConfigError if it does not fit.
    """
    if channels is None:
        return known or (), None if known else _UNNAMED
    room = channels - softmax
    if known is None:
        return default_names(room) or (tuple(f"class_{i}" for i in range(room)), _UNNAMED)
    if softmax and len(known) == channels and is_background(known[-1]):
        known = known[:-1]
    if len(known) > room or (len(known) < room and (exact or softmax)):
        hint = 'softmax counts the last class as "no object": check detector.activation' if softmax else None
        message = f"there are {len(known)} class names, but the model has {room} classes"
        raise ConfigError(message, where=str(network.path), hint=hint)
    return known, None


def _taken(classes: tuple[str, ...] | None, names: tuple[str, ...], network: Network) -> tuple[int, ...] | None:
    """Return the indices of the classes to keep, or None to keep all. classes: the names of the classes to keep. If it is
    None, only the background is left out."""
    if not names:
        numbers = [re.fullmatch("class_([0-9]{1,9})", name) for name in classes or ()]
        if not all(numbers):
            message = "detector.classes needs detector.names, because the classes of the model are class_0, class_1, ..."
            raise ConfigError(message, where=str(network.path))
        return tuple(int(number[1]) for number in numbers if number) if classes else None
    for name in classes or ():
        if name not in names:
            close = get_close_matches(name, names, n=3) or names[:10]
            message = f"detector.classes: the model has no class {name!r}"
            raise ConfigError(message, where=str(network.path), hint=f"it has {', '.join(close)}, ...")
    wanted = [not is_background(name) and (classes is None or name in classes) for name in names]
    return None if all(wanted) else tuple(i for i, want in enumerate(wanted) if want)
