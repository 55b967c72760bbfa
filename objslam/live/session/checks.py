"""What a message must be to be taken: values of any type as the numbers, names and cameras that they stand for, or None."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import COEFFICIENTS, Camera
from objslam.core.types import MAX_BOXES
from objslam.sources.journal.records import FrameMessage

LARGEST = 1e9
"""m, or px; numbers beyond it are no lengths. Larger takes more nonsense."""

_LATEST = 1e11
"""s; stamps beyond it are no stamps, since a float has no microseconds there."""
_RIGID = 1e-3
"""The most that an entry of R^T R may differ from the identity; larger takes matrices that are no rotation."""
_LONGEST_NAME = 1000
"""Letters that the name of a camera may have."""
_LETTERS = 80
"""Letters of a name that a report tells."""
_NUMBERS = "iufO"
"""Kinds of numpy arrays that may hold numbers: integers, unsigned ones, floats, and objects."""
_EXACT = 2**53
"""Whole numbers below it are exact in a float."""


def floats(values: object, *shape: int) -> Floats | None:
    """Values as an array of its own of that shape, None where they are none; without a box, any empty list has the shape."""
    found = _array(values, np.float64)
    if found is None or found.shape == shape:
        return found
    return found.reshape(shape) if found.size == 0 and 0 in shape else None


def track_numbers(values: object, count: int) -> Ints | None:
    """Track ids (count,), -1 where unknown, None where they are none; None or a list, as `Sink.push_detections` has it."""
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
    """A stamp, s, None where it is not finite or no number."""
    found = floats(value)
    return float(found) if found is not None and abs(float(found)) <= _LATEST else None


def label_list(labels: object) -> tuple[object, ...] | None:
    """Labels in their order, None where they have none."""
    if isinstance(labels, str | bytes | Mapping | Set) or not _is_short(labels):
        return None
    try:
        return tuple(labels)  # type: ignore[arg-type]
    except Exception:  # noqa: BLE001 - what somebody else made may raise anything: the message is refused and counted
        return None


def is_name(value: object) -> bool:
    """Whether a value is a text that can name something on one line."""
    return isinstance(value, str) and value.isprintable() and bool(value.strip())


def is_camera_name(value: object) -> bool:
    """Whether a value can name a camera."""
    return is_name(value) and len(str(value)) <= _LONGEST_NAME


def told(value: object) -> str:
    """A value of any type as a report names it: text and floats themselves, else what type it is."""
    if isinstance(value, str):
        return value[:_LETTERS] if value.isprintable() else ascii(value[:_LETTERS])
    return f"{value:.3f}" if isinstance(value, float) else f"of type {type(value).__name__}"


def rigid(pose: object) -> Floats | None:
    """The rigid pose (4, 4) as an array of its own, None where it is none."""
    matrix = floats(pose, 4, 4)
    if matrix is None or not np.isfinite(matrix).all() or np.abs(matrix[:3]).max() > LARGEST:
        return None
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        return None
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def sound_camera(camera: object) -> Camera | str:
    """The camera with arrays of its own; else what is wrong with it, to be said after "camera"."""
    if not isinstance(camera, Camera) or not is_camera_name(camera.name):
        return "without a name"
    matrix, distortion = floats(camera.matrix, 3, 3), _array(camera.distortion, np.float64)
    if matrix is None or not _is_pinhole(matrix):
        return "without a calibration"
    width, height = _count(camera.width), _count(camera.height)
    if width is None or height is None:
        return "without a size"
    model: object = camera.distortion_model
    counts = COEFFICIENTS.get(camera.distortion_model, ()) if isinstance(model, str) else ()
    if distortion is None or distortion.ndim != 1 or len(distortion) not in counts or not np.isfinite(distortion).all():
        return "with a lens model that is not known"
    base_T_camera = rigid(camera.base_T_camera)
    if base_T_camera is None:
        return "whose mount is no pose"
    scale = floats(camera.depth_scale)
    if scale is None or not 0 < float(scale) < math.inf:
        return "whose depth scale is not above zero"
    sees_size: object = camera.sees_size
    if not isinstance(sees_size, bool | np.bool_):
        return "that does not say whether it sees sizes"
    lens = matrix, camera.distortion_model, distortion
    return Camera(camera.name, width, height, *lens, base_T_camera, float(scale), bool(sees_size))


class SoundFrame(NamedTuple):
    """A frame as a message, without boxes that cannot be right; None where it is malformed as a whole.

    fault: what is wrong with it as a whole, to be said after that something was dropped. where: what a report calls it.
    left_out: boxes by what is wrong with them.
    """

    message: FrameMessage | None
    fault: str
    where: str
    left_out: dict[str, int]


def sound_frame(
    stamp: object,
    camera: str,
    boxes: object,
    labels: object,
    scores: object,
    depths: object,
    track_ids: object,
    whole: object,
) -> SoundFrame:
    """A frame as `Sink.push_detections` is given it, of values of any type."""
    where, given = f"camera {told(camera)}", stamp_of(stamp)
    if given is None:
        return SoundFrame(None, "frame without a stamp", where, {})
    where = f"{where}, stamp {given:.3f}"
    malformed = SoundFrame(None, "frame that is malformed", where, {})
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
    with np.errstate(invalid="ignore"):
        area = (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
        depth = np.where((depth > 0) & (depth <= LARGEST), depth, np.nan)
    rules: tuple[tuple[Bools, str], ...] = (
        (np.asarray(np.isfinite(corners).all(axis=1)), "box with a corner that is not finite"),
        (area, "box without area (x2 <= x1 or y2 <= y1)"),
        ((score >= 0) & (score <= 1), "box with a score outside 0 to 1"),
        (names, "box with a label that is empty or not printable"),
    )
    good, left_out = np.ones(count, dtype=bool), dict[str, int]()
    for fine, reason in rules:
        if not fine.all():
            left_out[reason] = int((good & ~fine).sum())
            good &= fine
    kept = np.flatnonzero(good)
    names_kept = tuple(str(words[i]) for i in kept.tolist())
    columns = corners[kept], names_kept, score[kept], depth[kept], track[kept]
    return SoundFrame(FrameMessage(given, camera, *columns, bool(whole)), "", where, left_out)


def _array(values: object, dtype: type | None = None) -> NDArray[Any] | None:
    """Values as an array of its own, None where they are no numbers (but text, truth values, times) or no array at all."""
    if not _is_short(values, scalar=True):
        return None
    try:
        with np.errstate(all="ignore"):
            found = np.array(values)
            if found.dtype.kind not in _NUMBERS:
                return None
            return found if dtype is None else found.astype(dtype)
    except Exception:  # noqa: BLE001 - what somebody else made may raise anything: the message is refused and counted
        return None


def _is_short(values: object, scalar: bool = False) -> bool:
    """Whether values are a list of any kind that is not too long to look at, or, where it may be, a scalar."""
    try:
        return len(values) <= MAX_BOXES  # type: ignore[arg-type]
    except Exception:  # noqa: BLE001 - the same
        return scalar


def _count(value: object) -> int | None:
    found = floats(value)
    return int(found) if found is not None and 1 <= float(found) <= LARGEST and float(found).is_integer() else None


def _is_pinhole(matrix: Floats) -> bool:
    focal = matrix[0, 0], matrix[1, 1]
    plain = matrix[1, 0] == 0 and np.array_equal(matrix[2], [0, 0, 1])
    return bool(plain and np.abs(matrix).max() <= LARGEST and min(focal) >= 1 / LARGEST)
