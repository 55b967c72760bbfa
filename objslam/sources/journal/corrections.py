"""What a live session found itself, and then corrected in its map, and its encoding as bytes for the journal."""

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.body import SHAPES
from objslam.core.calibration import Calibration
from objslam.core.noise import MOST_POSE_NOISE, NOMINAL, NoiseFactors
from objslam.core.validity import MAX_POSITION, covariance_fault
from objslam.sources.journal.fields import as_array, as_count, as_name

_CALIBRATION_KIND, _BODIES_KIND, _OBJECTS_KIND, _NAMES_KIND = b"S", b"B", b"A", b"K"
_OF_LOCALIZATION = ("heading", "heading_share", "heading_seconds", "place", "place_share", "place_seconds")
"""The fields of `NoiseFactors` that a calibration message has."""


@dataclass(frozen=True)
class CalibrationMessage:
    """The shared errors that a session corrects in its map and in all later messages, and the noise of its localisation.

    keyframe: the number of keyframes in the map before the correction. noise: only the fields `_OF_LOCALIZATION` count.
    """

    keyframe: int
    calibration: Calibration
    noise: NoiseFactors = NOMINAL


@dataclass(frozen=True)
class BodiesMessage:
    """The bodies of n landmarks, to whose centres a session turns its bearings.

    keyframe: the number of keyframes in the map before the correction. ids: (n,) of the landmarks. shape: (n,) index into
    `SHAPES`, 0 for a landmark whose bearings stay at the centres of its boxes. half: (n, 3) m, the half axes along the yaw,
    across it and upwards. yaw: (n,) rad in the map of the session. covariance: (n, 4, 4) of the half axes and the yaw.
    """

    keyframe: int
    ids: Ints
    shape: Ints
    half: Floats
    yaw: Floats
    covariance: Floats


@dataclass(frozen=True)
class ObjectsMessage:
    """Objects that a session found in boxes of its past, which belonged to no object, and landmarks that are no objects.

    keyframe: the number of keyframes in the map before the correction. rays: for each object, the numbers (n,) of its rays,
    in order. No ray has two objects. gone: (n,) the ids of the landmarks that are no objects.
    """

    keyframe: int
    rays: tuple[Ints, ...]
    gone: Ints


@dataclass(frozen=True)
class NamesMessage:
    """What the labels of a session are. A label in none of the arrays, which have no label in common, stays what it is.

    keyframe: the number of keyframes in the map before the correction. names: (n,) the numbers of the labels that name one
    object. several: (m,) of the labels with several objects. moving: (k,) of the labels of things that move.
    """

    keyframe: int
    names: Ints
    several: Ints
    moving: Ints


Correction = CalibrationMessage | BodiesMessage | ObjectsMessage | NamesMessage
"""What a session found itself, and then corrected in its map."""


def encode_correction(message: Correction) -> bytes:
    """Encode a correction. One of `CORRECTION_READERS` returns the same correction, bit for bit."""
    if isinstance(message, CalibrationMessage):
        found = message.calibration
        numbers = [array.tolist() for array in (found.values, found.covariance, found.prior)]
        noise = [getattr(message.noise, name) for name in _OF_LOCALIZATION]
        return _CALIBRATION_KIND + json.dumps([message.keyframe, found.names, *numbers, noise]).encode()
    if isinstance(message, BodiesMessage):
        arrays = (message.ids, message.shape, message.half, message.yaw, message.covariance)
        return _BODIES_KIND + json.dumps([message.keyframe, *(array.tolist() for array in arrays)]).encode()
    if isinstance(message, NamesMessage):
        kinds = [labels.tolist() for labels in (message.names, message.several, message.moving)]
        return _NAMES_KIND + json.dumps([message.keyframe, *kinds]).encode()
    objects = [rays.tolist() for rays in message.rays]
    return _OBJECTS_KIND + json.dumps([message.keyframe, objects, message.gone.tolist()]).encode()


def _read_calibration(data: bytes) -> CalibrationMessage:
    keyframe, names, values, covariance, prior, *noise = json.loads(data[1:])
    n = len(names)
    found = Calibration(
        tuple(map(as_name, names)), as_array(values, (n,)), as_array(covariance, (n, n)), as_array(prior, (n,))
    )
    fault = covariance_fault(found.covariance)
    if fault is not None:
        raise ValueError(f"the covariance of the calibration {fault}")
    return CalibrationMessage(as_count(keyframe), found, _noise(*noise))


def _noise(values: list[float] | None = None) -> NoiseFactors:
    """Return the noise of a localisation. Journals of older versions have none."""
    if values is None:
        return NOMINAL
    noise = dict(zip(_OF_LOCALIZATION, as_array(values, (len(_OF_LOCALIZATION),)).tolist(), strict=True))
    for name in ("heading", "place"):
        share, seconds = noise[f"{name}_share"], noise[f"{name}_seconds"]
        if not 0 < noise[name] <= MOST_POSE_NOISE or not 0 <= share <= 1 or seconds < 0 or (share > 0 and seconds == 0):
            raise ValueError(f"the noise of localised {name}s cannot be")
    return NoiseFactors(**noise)


def _read_bodies(data: bytes) -> BodiesMessage:
    keyframe, ids, shape, half, yaw, covariance = json.loads(data[1:])
    n = len(ids)
    shapes, sides = np.array([as_count(one) for one in shape], dtype=np.int64).reshape(n), as_array(half, (n, 3))
    spread = as_array(covariance, (n, 4, 4))
    if (shapes >= len(SHAPES)).any() or (sides[shapes > 0] <= 0).any() or (np.abs(sides) >= MAX_POSITION).any():
        raise ValueError("a body of an unknown shape, or of an impossible size")
    fault = covariance_fault(spread)
    if fault is not None:
        raise ValueError(f"the covariance of a body {fault}")
    numbers = np.array([as_count(one) for one in ids], dtype=np.int64)
    return BodiesMessage(as_count(keyframe), numbers, shapes, sides, as_array(yaw, (n,)), spread)


def _read_objects(data: bytes) -> ObjectsMessage:
    keyframe, objects, gone = json.loads(data[1:])
    rays = tuple(np.array([as_count(one) for one in numbers], dtype=np.int64) for numbers in objects)
    every = np.concatenate([*rays, np.zeros(0, dtype=np.int64)])
    if len(np.unique(every)) < len(every) or any(not len(one) or (np.diff(one) < 0).any() for one in rays):
        raise ValueError("rays of objects that repeat, or are not in order")
    return ObjectsMessage(as_count(keyframe), rays, np.array([as_count(one) for one in gone], dtype=np.int64))


def _read_names(data: bytes) -> NamesMessage:
    keyframe, *kinds = json.loads(data[1:])
    names, several, moving = (np.array([as_count(one) for one in labels], dtype=np.int64) for labels in kinds)
    every = np.concatenate([names, several, moving])
    if len(np.unique(every)) < len(every):
        raise ValueError("a label that is of two kinds")
    return NamesMessage(as_count(keyframe), names, several, moving)


CORRECTION_READERS: dict[bytes, Callable[[bytes], Correction]] = {
    _CALIBRATION_KIND: _read_calibration,
    _BODIES_KIND: _read_bodies,
    _OBJECTS_KIND: _read_objects,
    _NAMES_KIND: _read_names,
}
"""The reader of each kind of correction, by the first byte of its record."""
