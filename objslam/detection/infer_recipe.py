"""Settling a model's recipe: the settings go before the model's own description, that before its family's habits."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches

from objslam import config
from objslam.config import Layout, Role
from objslam.core.arrays import Array
from objslam.detection.class_names import default_names, is_background, names_from_metadata, names_from_settings
from objslam.detection.onnx_model import Network
from objslam.detection.output_layouts import Facts, Output, Roles, count_classes, recognise, rows_are_boxes
from objslam.detection.recipe import HABITS, PLAIN, Habits, InputSize, Recipe
from objslam.errors import ConfigError, DetectorError

DESCRIPTION = "objslam.detector"
"""Key of a model's metadata under which it may describe itself: JSON with keys of the settings' detector section."""

_NOT_A_MODELS = frozenset({"classes", "min_score", "iou", "max_boxes", "size", "device", "threads", "batch"})
_SIZE, _LARGEST, _STRIDE, _PAD = 640, 8192, 32, 114
_QUERIES = 300  # of the newer ones of the DETR family; DETR itself and its close kin have 100
_UNNAMED = "the model names no classes: they are numbered (give detector.names)"


def with_description(network: Network, settings: config.Detector) -> config.Detector:
    """The settings, with what is left open in them filled from the model's own description, where it brings one.

    DetectorError where that is wrong.
    """
    text = network.metadata.get(DESCRIPTION)
    if text is None:
        return settings
    try:
        told = config.Detector.model_validate(json.loads(text))
        beyond = told.model_fields_set & _NOT_A_MODELS
        if beyond:
            raise ValueError(f"{min(beyond)} is not for a model to say")
    except (ValueError, RecursionError) as error:  # pydantic's and json's errors are ValueErrors
        message = f"{DESCRIPTION} in the model's metadata is wrong: {'; '.join(str(error).splitlines()[:3])}"
        raise DetectorError(message, where=str(network.path)) from error
    return settings.model_copy(
        update={key: getattr(told, key) for key in told.model_fields_set if getattr(settings, key) is None}
    )


def input_size(network: Network, settings: config.Detector) -> InputSize:
    """The model's own size, else the settings', else that of the training (in the metadata), else 640.

    ConfigError where the settings want another than the model's.
    """
    image = network.image
    width, height = settings.size or _told_size(network.metadata) or (_SIZE, _SIZE)
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
    """The recipe for a model that gave these outputs on one image of the size, and a warning where names were made up.

    ConfigError or DetectorError where none can be: a layout that is not known, another task, names that do not fit.
    """
    task = network.metadata.get("task", "detect")
    if task in ("classify", "obb"):
        message = f"the model's task is {task}: it gives no boxes along the image's axes"
        raise DetectorError(message, where=str(network.path), hint="a detection model is needed")
    given = names_from_settings(settings.names, network.path)
    known = given or names_from_metadata(network.metadata.get("names"), network.path)
    facts = Facts(size.height, size.width, len(known) if known else None, network.metadata)
    layout, roles = recognise(outputs, settings, facts, network.path)
    values = {output.name: output.values for output in outputs}
    named = {role: values[name] for role, name in roles.items()}
    bytes_in = network.image.tensor.kind == "uint8"
    if bytes_in and not (settings.divide_by is None and settings.mean is None and settings.std is None):
        message = "the model takes bytes as they are: detector.divide_by, mean and std cannot be set"
        raise ConfigError(message, where=str(network.path))
    habits = _habits(layout, roles, named, facts, free_size=size.free_width or size.free_height, bytes_in=bytes_in)
    activation = settings.activation or habits.activation
    channels = count_classes(layout, named, facts)
    names, warning = _fit_names(network, known, channels, softmax=activation == "softmax", exact=given is not None)
    from_1 = layout == "ssd" and (network.image.batch == 0 or _is_tensorflow(roles))  # as torchvision and TensorFlow count
    from_1 = from_1 and bool(names) and not is_background(names[0])
    recipe = Recipe(
        layout=layout,
        outputs=dict(roles),
        size=size,
        resize=settings.resize or ("stretch" if settings.size and habits.resize == "none" else habits.resize),
        pad=_PAD if settings.pad is None else settings.pad,
        colour=settings.colour or habits.colour,
        divide_by=settings.divide_by or habits.divide_by,
        mean=settings.mean or habits.normalise[0],
        std=settings.std or habits.normalise[1],
        names=names,
        first_label=int(from_1) if settings.first_label is None else settings.first_label,
        taken=_taken(settings.classes, names, network),
        channels=channels if channels is None or activation == "softmax" else len(names),
        row_boxes=layout != "yolov8" or rows_are_boxes(named["predictions"], facts.classes),
        box_form=settings.box_form or habits.box_form,
        box_units=settings.box_units or habits.box_units,
        activation=activation,
        nms=habits.nms if settings.nms is None else settings.nms,
        min_score=settings.min_score,
        iou=settings.iou,
        max_boxes=settings.max_boxes,
    )
    return recipe, warning


def _habits(
    layout: Layout, roles: Roles, named: Mapping[Role, Array], facts: Facts, *, free_size: bool, bytes_in: bool
) -> Habits:
    """The habits of the layout, and where some of its models have others, theirs."""
    habits = HABITS[layout]
    if layout == "ssd" and free_size:
        habits = replace(habits, resize="none")  # such models resize inside
    if _is_tensorflow(roles):
        habits = replace(habits, box_form="yxyx", box_units="fractions")
    if layout == "end_to_end" and facts.ultralytics_detr:
        habits = replace(habits, resize="stretch", box_form="cxcywh", box_units="fractions")
    if layout == "detr" and "predictions" in named:  # RT-DETR as Ultralytics exported it
        habits = replace(habits, activation="none", normalise=PLAIN)
    elif layout == "detr":
        queries, classes = named["logits"].shape[-2:]
        old = queries < _QUERIES
        if classes == facts.classes + 1 if facts.classes is not None else old:
            habits = replace(habits, activation="softmax")
        if not old and roles["boxes"] != "dets":  # RT-DETR and its kin; RF-DETR, whose boxes are "dets", normalises
            habits = replace(habits, normalise=PLAIN)
    return replace(habits, divide_by=1.0, normalise=PLAIN) if bytes_in else habits


def _told_size(metadata: Mapping[str, str]) -> tuple[int, int] | None:
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
    """The names for the channels; where they are the metadata's, channels after them (masks, key points) are none."""
    if channels is None:
        return known or (), None if known else _UNNAMED
    room = channels - softmax
    if known is None:
        return default_names(room) or (tuple(f"class_{i}" for i in range(room)), _UNNAMED)
    if softmax and len(known) == channels and is_background(known[-1]):
        known = known[:-1]
    if len(known) > room or (len(known) < room and (exact or softmax)):
        hint = 'after softmax the last class means "nothing": is that so? (detector.activation)' if softmax else None
        message = f"there are {len(known)} class names, the model has {room} classes"
        raise ConfigError(message, where=str(network.path), hint=hint)
    return known, None


def _taken(classes: tuple[str, ...] | None, names: tuple[str, ...], network: Network) -> tuple[int, ...] | None:
    """The classes that count, all but the background if the settings list none; ConfigError for one that is not there."""
    if not names:
        numbers = [re.fullmatch("class_([0-9]{1,9})", name) for name in classes or ()]
        if not all(numbers):
            message = "detector.classes needs detector.names: the model names no classes, they are class_0, class_1, ..."
            raise ConfigError(message, where=str(network.path))
        return tuple(int(number[1]) for number in numbers if number) if classes else None
    for name in classes or ():
        if name not in names:
            close = get_close_matches(name, names, n=3) or names[:10]
            message = f"detector.classes: the model has no class {name!r}"
            raise ConfigError(message, where=str(network.path), hint=f"it has {', '.join(close)}, ...")
    wanted = [not is_background(name) and (classes is None or name in classes) for name in names]
    return None if all(wanted) else tuple(i for i, want in enumerate(wanted) if want)
