"""The corrections that a live session found itself and made in its map, and their encoding as bytes for the journal."""

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.body import SHAPES
from objslam.core.calibration import Calibration
from objslam.core.noise import MOST_POSE_NOISE, NOMINAL, NoiseFactors
from objslam.core.validity import MAX_POSITION, covariance_fault
from objslam.sources.journal.fields import as_array, as_count, as_name, as_pose

_CALIBRATION_KIND, _BODIES_KIND, _ASSOCIATION_KIND, _NAMES_KIND = b"S", b"B", b"R", b"K"
_OF_LOCALIZATION = ("heading", "heading_share", "heading_seconds", "place", "place_share", "place_seconds")
"""The fields of `NoiseFactors` that a calibration message has."""


@dataclass(frozen=True)
class CalibrationMessage:
    """The shared errors that a session corrects in its map and in all later messages, and the noise of its localisation.

    keyframe: the number of keyframes in the map before the correction. noise: only its fields `_OF_LOCALIZATION` are used.
    """

    keyframe: int
    calibration: Calibration
    noise: NoiseFactors = NOMINAL


@dataclass(frozen=True)
class BodiesMessage:
    """The bodies of n landmarks. A session corrects its bearings so that they point to the centres of the bodies.

    keyframe: the number of keyframes in the map before the correction. ids: (n,) ids of the landmarks. shape: (n,) index
    into `SHAPES`, 0 for a landmark whose bearings stay at the centres of its boxes. half: (n, 3) half axes along the yaw,
    across the yaw and upwards, m. yaw: (n,) rad, in the map of the session. covariance: (n, 4, 4) covariance of the three
    half axes and the yaw, in m and rad.
    """

    keyframe: int
    ids: Ints
    shape: Ints
    half: Floats
    yaw: Floats
    covariance: Floats


@dataclass(frozen=True)
class AssociationMessage:
    """The object of each ray of a session, and the path of the session. An association of the whole drive found both.

    keyframe: the number of keyframes in the map before the correction. rays: for each of N objects, the increasing numbers
    (n,) of its rays. positions: (N, 3) positions of the objects, m. free: (n,) increasing numbers of the rays of no object.
    No ray number occurs twice in `rays` and `free`. keyframes: (K,) ids of the keyframes. map_T_camera: (K, 4, 4) poses of
    the keyframes. Their frame map may differ from the map of the session.
    """

    keyframe: int
    rays: tuple[Ints, ...]
    positions: Floats
    free: Ints
    keyframes: Ints
    map_T_camera: Floats


@dataclass(frozen=True)
class NamesMessage:
    """The kinds of the labels of a session. A label is in at most one of the arrays. A label in no array keeps its kind.

    keyframe: the number of keyframes in the map before the correction. names: (n,) numbers of the labels that name a single
    object. several: (m,) numbers of the labels of several objects. moving: (k,) numbers of the labels of things that move.
    """

    keyframe: int
    names: Ints
    several: Ints
    moving: Ints


Correction = CalibrationMessage | BodiesMessage | AssociationMessage | NamesMessage
"""A correction that a session found itself and made in its map."""


def encode_correction(message: Correction) -> bytes:
    """Return a correction as bytes. The reader in `CORRECTION_READERS` returns the same correction, bit for bit."""
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
    rest = [one.tolist() for one in (message.positions, message.free, message.keyframes, message.map_T_camera)]
    return _ASSOCIATION_KIND + json.dumps([message.keyframe, objects, *rest]).encode()


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
    """Return the noise of the localisation. Journals of older versions have no `values`, which gives `NOMINAL`."""
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
    return BodiesMessage(as_count(keyframe), _counts(ids), shapes, sides, as_array(yaw, (n,)), spread)


def _read_association(data: bytes) -> AssociationMessage:
    keyframe, objects, positions, free, keyframes, poses = json.loads(data[1:])
    rays, others, ids = tuple(map(_counts, objects)), _counts(free), _counts(keyframes)
    every = np.concatenate([*rays, others])
    in_order = all((np.diff(one) > 0).all() for one in (*rays, others, ids))
    if len(np.unique(every)) < len(every) or not all(len(one) for one in rays) or not in_order:
        raise ValueError("rays or keyframes of an association that repeat, or are not in order")
    places = as_array(positions, (len(rays), 3))
    if (np.abs(places) >= MAX_POSITION).any():
        raise ValueError("an object that is too far away")
    at = np.array([as_pose(pose) for pose in poses]).reshape(len(ids), 4, 4)
    return AssociationMessage(as_count(keyframe), rays, places, others, ids, at)


def _counts(values: list[int]) -> Ints:
    return np.array([as_count(one) for one in values], dtype=np.int64)


def _read_names(data: bytes) -> NamesMessage:
    keyframe, *kinds = json.loads(data[1:])
    names, several, moving = map(_counts, kinds)
    every = np.concatenate([names, several, moving])
    if len(np.unique(every)) < len(every):
        raise ValueError("a label that is of two kinds")
    return NamesMessage(as_count(keyframe), names, several, moving)


CORRECTION_READERS: dict[bytes, Callable[[bytes], Correction]] = {
    _CALIBRATION_KIND: _read_calibration,
    _BODIES_KIND: _read_bodies,
    _ASSOCIATION_KIND: _read_association,
    _NAMES_KIND: _read_names,
}
"""The function that reads each kind of correction. The key is the first byte of the record."""
