"""The messages that a live session accepts, and their encoding as bytes for the journal."""

import json
import struct
from bisect import bisect_right
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.errors import LogError

PathKind = Literal["odometry", "localization"]

_POSE = struct.Struct("<c13d")  # The bytes of a pose message: its kind, its stamp and the upper three rows of the matrix.
_MOUNT = struct.Struct("<cd12dH")  # The bytes of a mount message: the same, then the length of the camera's name.
_KINDS: dict[PathKind, bytes] = {"odometry": b"O", "localization": b"L"}
_PATHS: dict[bytes, PathKind] = {kind: path for path, kind in _KINDS.items()}
_MOUNT_KIND, _CAMERA_KIND, _FRAME_KIND, _NOTE_KIND = b"M", b"C", b"F", b"N"
CALIBRATION_KIND = b"S"
"""The first byte of a calibration message."""


@dataclass(frozen=True)
class PoseMessage:
    """The robot's pose at a stamp (s). For odometry, `pose` is odom_T_base (4, 4). For localisation, it is map_T_base."""

    path: PathKind
    stamp: float
    pose: Floats


@dataclass(frozen=True)
class MountMessage:
    """The pose base_T_camera (4, 4) of a moving camera on the robot. It holds from its stamp (s) until the next mount."""

    stamp: float
    camera: str
    pose: Floats


class HeldMounts:
    """The mounts of one camera, which are its poses on the robot. Each mount holds until the next."""

    def __init__(self, most: int | None = None) -> None:
        """Start without mounts. most: how many of the newest mounts are kept. None keeps all."""
        self._most = most
        self._stamps: list[float] = []
        self._poses: list[Floats] = []

    def add(self, message: MountMessage) -> None:
        """Add a mount. It replaces a mount that was added before with the same stamp."""
        at = bisect_right(self._stamps, message.stamp)
        self._stamps.insert(at, message.stamp)
        self._poses.insert(at, message.pose)
        if self._most is not None and len(self._stamps) > self._most:
            del self._stamps[0], self._poses[0]

    def at(self, stamp: float, camera: Camera) -> Floats:
        """Return base_T_camera (4, 4) at a stamp (s). Before the first mount, it is the one in `camera`."""
        at = bisect_right(self._stamps, stamp)
        return self._poses[at - 1] if at else camera.base_T_camera


@dataclass(frozen=True)
class CameraMessage:
    """A new camera, or a new calibration of a known camera."""

    camera: Camera


@dataclass(frozen=True)
class FrameMessage:
    """The B boxes of one image. The fields boxes (B, 4), scores, depths, track_ids (B,) and whole are as in `Detections`."""

    stamp: float
    camera: str
    boxes: Floats
    labels: tuple[str, ...]
    scores: Floats
    depths: Floats
    track_ids: Ints
    whole: bool = False

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True)
class NoteMessage:
    """A record of offsets, which apply to all later messages of a session.

    clock: s, added to stamps. odometry: start_T_odom (4, 4).
    """

    clock: float
    odometry: Floats


@dataclass(frozen=True)
class CalibrationMessage:
    """The shared errors that a session takes out of its map and of all later messages.

    keyframe: the number of keyframes that the map had before it took them out.
    """

    keyframe: int
    calibration: Calibration


Message = PoseMessage | MountMessage | CameraMessage | FrameMessage | NoteMessage | CalibrationMessage


def encode(message: Message) -> bytes:
    """Encode a message. `decode` returns the same message, bit for bit."""
    if isinstance(message, PoseMessage):
        return _POSE.pack(_KINDS[message.path], message.stamp, *message.pose[:3].ravel().tolist())
    if isinstance(message, MountMessage):
        name = message.camera.encode()
        return _MOUNT.pack(_MOUNT_KIND, message.stamp, *message.pose[:3].ravel().tolist(), len(name)) + name
    if isinstance(message, NoteMessage):
        return _NOTE_KIND + json.dumps([message.clock, message.odometry.ravel().tolist()]).encode()
    if isinstance(message, CalibrationMessage):
        found = message.calibration
        numbers = [array.tolist() for array in (found.values, found.covariance, found.prior)]
        return CALIBRATION_KIND + json.dumps([message.keyframe, found.names, *numbers]).encode()
    if isinstance(message, CameraMessage):
        c = message.camera
        data = [c.name, c.width, c.height, c.matrix.ravel().tolist(), c.distortion_model, c.distortion.tolist()]
        return _CAMERA_KIND + json.dumps([*data, c.base_T_camera.ravel().tolist(), c.depth_scale, c.sees_size]).encode()
    known = np.where(np.isfinite(message.depths), message.depths, -1.0)
    numbers = [column.tolist() for column in (message.scores, known, message.track_ids)]
    row = [message.stamp, message.camera, message.boxes.tolist(), message.labels, *numbers, *[True] * message.whole]
    return _FRAME_KIND + json.dumps(row).encode()


def decode(data: bytes) -> Message:
    """Decode a message. Raises LogError if the bytes are no message."""
    kind = data[:1]
    try:
        if kind in _PATHS:
            _, stamp, *rows = _POSE.unpack(data)
            return PoseMessage(_PATHS[kind], stamp, _pose(rows))
        if kind == _MOUNT_KIND:
            _, stamp, *rows, length = _MOUNT.unpack_from(data)
            name = data[_MOUNT.size :]
            if len(name) != length:
                raise ValueError("the camera's name has not the length that the record states")
            return MountMessage(stamp, name.decode(), _pose(rows))
        if kind == _NOTE_KIND:
            clock, odometry = json.loads(data[1:])
            return NoteMessage(float(clock), _array(odometry, (4, 4)))
        if kind == CALIBRATION_KIND:
            keyframe, names, values, covariance, prior = json.loads(data[1:])
            n = len(names)
            numbers = _array(values, (n,)), _array(covariance, (n, n)), _array(prior, (n,))
            return CalibrationMessage(int(keyframe), Calibration(tuple(map(str, names)), *numbers))
        if kind == _CAMERA_KIND:
            name, width, height, matrix, model, distortion, base_T_camera, scale, *more = json.loads(data[1:])
            lens = (_array(matrix, (3, 3)), model, _array(distortion, (-1,)))
            sees_size = bool(more[0]) if more else True  # Older journals do not store the flag.
            return CameraMessage(Camera(name, width, height, *lens, _array(base_T_camera, (4, 4)), scale, sees_size))
        if kind == _FRAME_KIND:
            stamp, camera, boxes, labels, scores, depths, tracks, *whole = json.loads(data[1:])
            if whole not in ([], [True]):
                raise ValueError("the frame has too many fields")
            known = _array(depths, (len(labels),))
            return FrameMessage(
                float(stamp),
                camera,
                _array(boxes, (len(labels), 4)),
                tuple(labels),
                _array(scores, (len(labels),)),
                np.where(known > 0, known, np.nan),
                np.array(tracks, dtype=np.int64).reshape(len(labels)),
                bool(whole),
            )
    except (ValueError, TypeError, struct.error) as error:
        raise LogError(f"journal record that cannot be read: {error}") from error
    raise LogError(f"journal record of an unknown kind {kind!r}")


def _pose(rows: list[float]) -> Floats:
    return np.array([*rows, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)


def _array(values: list[float], shape: tuple[int, ...]) -> Floats:
    array = np.array(values, dtype=np.float64).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array
