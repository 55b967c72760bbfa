"""Checks of pushed messages. They turn values of any type into valid numbers, labels, cameras and frames, or refuse them."""

from collections.abc import Mapping, Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import COEFFICIENTS, Camera, RangeNoise
from objslam.core.types import MAX_BOXES
from objslam.core.validity import (
    MAX_LIVE_STAMP,
    box_rules,
    camera_fault,
    is_name,
    rigid_pose,
    unit_of_date,
    valid_depths,
    valid_stamps,
)
from objslam.sources.journal.records import FrameMessage

_LONGEST_NAME = 1000  # The most characters of a camera's name. A larger number accepts longer names.
_LETTERS = 80  # The most characters that a report shows of a text in a message. A larger number makes longer lines.
_NUMBERS = "iufO"  # The numpy kinds of arrays that may hold numbers: signed and unsigned integers, floats, and objects.
_MOST_COEFFICIENTS = max(map(max, COEFFICIENTS.values()))  # A model never has more. Larger counts are not reported.
_SHARE = "box between 0 and 1, a share of the image instead of px"  # The reason for which such a box is dropped.
_EXACT = 2**53  # The bound below which a float represents every whole number exactly.


def floats(values: object, *shape: int) -> Floats | None:
    """Copy values into an array of a shape. Return None if that fails. An empty list fits every shape that contains a 0."""
    if type(values) is np.ndarray and values.dtype == np.float64 and values.shape == shape:
        return values.copy()  # Nearly all messages end here. A plain array raises no errors of a foreign object.
    found = _array(values, np.float64)
    if found is None or found.shape == shape:
        return found
    return found.reshape(shape) if found.size == 0 and 0 in shape else None


def track_numbers(values: object, count: int) -> Ints | None:
    """Copy the ids of `Sink.push_detections` into an array (count,), -1 for unknown ids. Return None for invalid ids."""
    if values is None:
        return np.full(count, -1, dtype=np.int64)
    found = _array(values)
    if found is None or found.shape != (count,):
        return None
    if found.dtype.kind == "f" and not ((np.abs(found) < _EXACT) & (found == np.floor(found))).all():
        return None
    if found.dtype.kind == "u" and (found > np.iinfo(np.int64).max).any():
        return None
    tracks = _array(found, np.int64)
    return None if tracks is None else np.maximum(tracks, -1)


def stamp_of(value: object) -> float | None:
    """Return a stamp, s, or None if the value is not a number, not finite or out of range."""
    if type(value) is float:
        return value if abs(value) <= MAX_LIVE_STAMP else None
    found = floats(value)
    return float(found) if found is not None and valid_stamps(found, MAX_LIVE_STAMP) else None


def stamp_fault(value: object) -> str:
    """Return what is wrong with a value for which `stamp_of` returns None, in words that follow the name of a message."""
    found = floats(value)
    if found is None or not found > MAX_LIVE_STAMP:
        return "without a stamp"
    return (
        "with a stamp that is no time in s"
        if np.isinf(found)
        else f"with a stamp in {unit_of_date(float(found))} instead of s"
    )


def label_list(labels: object) -> tuple[object, ...] | None:
    """Return labels as a tuple. Return None for a text, an unordered collection or more than MAX_BOXES labels."""
    if isinstance(labels, str | bytes | Mapping | Set) or not _is_short(labels):
        return None
    try:
        return tuple(labels)  # type: ignore[arg-type]
    except Exception:  # noqa: BLE001 - a foreign object may raise anything; its message is refused and counted
        return None


def is_camera_name(value: object) -> bool:
    """Return whether a value can name a camera."""
    return is_name(value) and len(str(value)) <= _LONGEST_NAME


def told(value: object) -> str:
    """Return the name of a value in reports: a text or a float itself, and the type of any other value."""
    if isinstance(value, str):
        return value[:_LETTERS] if value.isprintable() else ascii(value[:_LETTERS])
    return f"{value:.3f}" if isinstance(value, float) else f"of type {type(value).__name__}"


def rigid(pose: object) -> Floats | None:
    """Copy a rigid pose into an array (4, 4) with an exact rotation, or return None if `validity.rigid_pose` refuses it."""
    matrix = floats(pose, 4, 4)
    return None if matrix is None else rigid_pose(matrix)


def sound_camera(camera: object) -> Camera | str:
    """Return a copy of a valid camera. For an invalid camera, return its fault in words that follow "camera"."""
    if not isinstance(camera, Camera) or not is_camera_name(camera.name):
        return "without a name"
    matrix, distortion = floats(camera.matrix, 3, 3), _array(camera.distortion, np.float64)
    if matrix is None:
        return "without a calibration"
    width, height = _count(camera.width), _count(camera.height)
    if width is None or height is None:
        return "without a size"
    model: object = camera.distortion_model
    if distortion is None or distortion.size > _MOST_COEFFICIENTS or not isinstance(model, str) or model not in COEFFICIENTS:
        return "with an unknown lens model"
    base_T_camera = rigid(camera.base_T_camera)
    if base_T_camera is None:
        return "whose mount is not a rigid pose"
    scale = floats(camera.depth_scale)
    if scale is None:
        return "whose depth scale is not above zero"
    sees_size: object = camera.sees_size
    if not isinstance(sees_size, bool | np.bool_):
        return "whose sees_size is neither true nor false"
    noise: object = camera.depth_noise
    if noise is not None and not isinstance(noise, RangeNoise):
        return "whose depth_noise is not a RangeNoise"
    lens = matrix, camera.distortion_model, distortion
    copied = Camera(camera.name, width, height, *lens, base_T_camera, float(scale), bool(sees_size), noise)
    return camera_fault(copied) or copied


def sound_frame(
    stamp: Any, camera: str, boxes: Any, labels: Any, scores: Any, depths: Any, track_ids: Any, whole: Any
) -> tuple[FrameMessage | None, str, str, dict[str, int]]:
    """Check the arguments of `Sink.push_detections`, which may be of any type.

    Return four values. The first is the frame without its invalid boxes, or None if the whole frame is malformed. The second
    is the reason to drop the whole frame, or "". The third is the frame's name in reports. The last is the number of invalid
    boxes by reason.
    """
    where, given = f"camera {told(camera)}", stamp_of(stamp)
    if given is None:
        return None, f"frame {stamp_fault(stamp)}", where, {}
    where = f"{where}, stamp {given:.3f}"
    malformed = None, "frame that is malformed", where, dict[str, int]()
    words = label_list(labels)
    if words is None or not is_camera_name(camera) or not isinstance(whole, bool | np.bool_):
        return malformed
    count = len(words)
    corners, score = floats(boxes, count, 4), floats(scores, count)
    depth = np.full(count, np.nan) if depths is None else floats(depths, count)
    track = track_numbers(track_ids, count)
    if corners is None or score is None or depth is None or track is None:
        return malformed
    names = np.array([is_name(word) for word in words], dtype=bool)
    rules = (*box_rules(corners, score, names), (~_are_shares(corners), _SHARE))
    depth = np.where(valid_depths(depth), depth, np.nan)
    good, left_out = np.ones(count, dtype=bool), dict[str, int]()
    for fine, reason in rules:
        if not fine.all():
            left_out[reason] = int((good & ~fine).sum())
            good &= fine
    kept = np.flatnonzero(good)
    columns = corners[kept], tuple(str(words[i]) for i in kept.tolist()), score[kept], depth[kept], track[kept]
    return FrameMessage(given, camera, *columns, bool(whole)), "", where, left_out


def _are_shares(corners: Floats) -> Bools:
    """Return which boxes (M, 4) lie between 0 and 1. No detector finds boxes of less than a pixel in an image's corner."""
    return np.asarray(((corners >= 0) & (corners <= 1)).all(axis=1))


def _array(values: object, dtype: type | None = None) -> NDArray[Any] | None:
    """Copy values into an array. Return None for too many values, or if they form no array of numbers. Booleans are no
    numbers here."""
    if not _is_short(values, scalar=True):
        return None
    try:
        with np.errstate(all="ignore"):
            found = np.array(values)
            if found.dtype.kind not in _NUMBERS:
                return None
            return found if dtype is None else found.astype(dtype)
    except Exception:  # noqa: BLE001 - a foreign object may raise anything; its message is refused and counted
        return None


def _is_short(values: object, scalar: bool = False) -> bool:
    """Return whether values have a length of at most MAX_BOXES. For values without a length, return `scalar`."""
    try:
        return len(values) <= MAX_BOXES  # type: ignore[arg-type]
    except Exception:  # noqa: BLE001 - a foreign object may raise anything
        return scalar


def _count(value: object) -> int | None:
    found = floats(value)
    return int(found) if found is not None and float(found).is_integer() else None
