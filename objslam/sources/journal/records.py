"""The messages that a live session accepts, and their encoding as bytes for the journal."""

import json
import struct
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.camera import COEFFICIENTS, Camera, RangeNoise
from objslam.core.validity import box_rules, camera_fault, is_name, valid_depths
from objslam.errors import LogError
from objslam.sources.journal.corrections import CORRECTION_READERS, Correction, encode_correction
from objslam.sources.journal.fields import as_array, as_count, as_name, as_pose, as_stamp

PathKind = Literal["odometry", "localization"]

_POSE = struct.Struct("<c13d")  # The bytes of a pose message: the kind, the stamp and the upper three rows of the matrix.
_MOUNT = struct.Struct("<cd12dH")  # The bytes of a mount message: the bytes of a pose message, then the name's length.
_KINDS: dict[PathKind, bytes] = {"odometry": b"O", "localization": b"L"}
_PATHS: dict[bytes, PathKind] = {kind: path for path, kind in _KINDS.items()}
_MOUNT_KIND, _CAMERA_KIND, _FRAME_KIND, _NOTE_KIND = b"M", b"C", b"F", b"N"
_STOP_KIND = b"E"
_LONGEST_REASON = 200  # The largest number of letters of a reason that are shown. A larger number shows more letters.


@dataclass(frozen=True)
class PoseMessage:
    """The robot's pose at a stamp (s). For odometry, `pose` is odom_T_base (4, 4). For localisation, it is map_T_base."""

    path: PathKind
    stamp: float
    pose: Floats


@dataclass(frozen=True)
class MountMessage:
    """The pose base_T_camera (4, 4) of a moving camera, valid from `stamp` (s) until the next mount. camera: its name."""

    stamp: float
    camera: str
    pose: Floats


class HeldMounts:
    """The mounts of one camera, which are its poses on the robot. Each mount is valid until the next one."""

    def __init__(self, most: int | None = None) -> None:
        """Start without mounts. most: the largest number of mounts that are kept, the newest ones. None keeps all."""
        self._most = most
        self._stamps: list[float] = []
        self._poses: list[Floats] = []

    def add(self, message: MountMessage) -> None:
        """Add a mount. The new mount replaces an earlier one with the same stamp."""
        at = bisect_right(self._stamps, message.stamp)
        self._stamps.insert(at, message.stamp)
        self._poses.insert(at, message.pose)
        if self._most is not None and len(self._stamps) > self._most:
            del self._stamps[0], self._poses[0]

    def at(self, stamp: float, camera: Camera) -> Floats:
        """Return base_T_camera (4, 4) at a stamp (s). Before the first mount, this is `camera.base_T_camera`."""
        at = bisect_right(self._stamps, stamp)
        return self._poses[at - 1] if at else camera.base_T_camera


@dataclass(frozen=True)
class CameraMessage:
    """A new camera, or a new calibration of a known camera."""

    camera: Camera


@dataclass(frozen=True)
class FrameMessage:
    """The B boxes of one image of the camera named `camera`. stamp: s. The other fields are as in `Detections`.

    boxes has shape (B, 4). labels, scores, depths and track_ids have B elements.
    """

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
    """The offsets that a session adds to later stamps and odometry, after the robot's clock or odometry jumped.

    clock: the offset that is added to stamps, s. odometry: start_T_odom (4, 4), the pose of the present odom frame in the
    first odom frame of the session.
    """

    clock: float
    odometry: Floats


Message = PoseMessage | MountMessage | CameraMessage | FrameMessage | NoteMessage | Correction


def encode_stop(reason: str) -> bytes:
    """Return the bytes of the record with the reason why a session stopped the journal."""
    return _STOP_KIND + json.dumps([reason]).encode()


def is_stop(data: bytes) -> bool:
    """Return whether a record contains the reason why a session stopped the journal."""
    return data.startswith(_STOP_KIND)


def read_stop(data: bytes) -> str:
    """Return the reason why a session stopped the journal. Raises LogError if the bytes cannot be read."""
    try:
        (reason,) = json.loads(data[1:])
    except (ValueError, TypeError, RecursionError) as error:
        raise LogError(f"journal record that cannot be read: {error}") from error
    return str(reason)[:_LONGEST_REASON]


def encode(message: Message) -> bytes:
    """Return a message as bytes. `decode` returns the same message, bit for bit."""
    if isinstance(message, PoseMessage):
        return _POSE.pack(_KINDS[message.path], message.stamp, *message.pose[:3].ravel().tolist())
    if isinstance(message, MountMessage):
        name = message.camera.encode()
        return _MOUNT.pack(_MOUNT_KIND, message.stamp, *message.pose[:3].ravel().tolist(), len(name)) + name
    if isinstance(message, Correction):
        return encode_correction(message)
    if isinstance(message, NoteMessage):
        return _NOTE_KIND + json.dumps([message.clock, message.odometry.ravel().tolist()]).encode()
    if isinstance(message, CameraMessage):
        c = message.camera
        data = [c.name, c.width, c.height, c.matrix.ravel().tolist(), c.distortion_model, c.distortion.tolist()]
        noise = [] if c.depth_noise is None else [astuple(c.depth_noise)]
        last = [c.base_T_camera.ravel().tolist(), c.depth_scale, c.sees_size, *noise]
        return _CAMERA_KIND + json.dumps([*data, *last]).encode()
    known = np.where(np.isfinite(message.depths), message.depths, -1.0)
    numbers = [column.tolist() for column in (message.scores, known, message.track_ids)]
    row = [message.stamp, message.camera, message.boxes.tolist(), message.labels, *numbers, *[True] * message.whole]
    return _FRAME_KIND + json.dumps(row).encode()


def decode(data: bytes) -> Message:
    """Return the message in the bytes. Raises LogError if the bytes are no message, or contain an invalid value."""
    try:
        reader = _READERS.get(data[:1])
        if reader is None:
            raise LogError(f"journal record of an unknown kind {data[:1]!r}")
        return reader(data)
    except (ValueError, TypeError, OverflowError, RecursionError, struct.error) as error:
        raise LogError(f"journal record that cannot be read: {error}") from error


def _read_pose(data: bytes) -> PoseMessage:
    kind, stamp, *rows = _POSE.unpack(data)
    return PoseMessage(_PATHS[kind], as_stamp(stamp), as_pose([*rows, 0.0, 0.0, 0.0, 1.0]))


def _read_mount(data: bytes) -> MountMessage:
    _, stamp, *rows, length = _MOUNT.unpack_from(data)
    name = data[_MOUNT.size :]
    if len(name) != length:
        raise ValueError("the camera's name does not have the length that the record states")
    return MountMessage(as_stamp(stamp), as_name(name.decode()), as_pose([*rows, 0.0, 0.0, 0.0, 1.0]))


def _read_note(data: bytes) -> NoteMessage:
    clock, odometry = json.loads(data[1:])
    return NoteMessage(as_stamp(clock), as_pose(odometry))


def _read_camera(data: bytes) -> CameraMessage:
    name, width, height, matrix, model, distortion, base_T_camera, scale, *more = json.loads(data[1:])
    known = next((one for one in COEFFICIENTS if one == model), None)
    if known is None:
        raise ValueError("an unknown lens model")
    inner, outer = as_array(matrix, (3, 3)), as_array(distortion, (-1,))
    # Older journals do not store `sees_size`. The noise of depths is stored only if a sensor has its own.
    sees_size = bool(more[0]) if more else True
    noise = RangeNoise(*as_array(more[1], (3,)).tolist()) if len(more) > 1 else None
    size = as_count(width), as_count(height)
    camera = Camera(as_name(name), *size, inner, known, outer, as_pose(base_T_camera), float(scale), sees_size, noise)
    fault = camera_fault(camera)
    if fault is not None:
        raise ValueError(f"camera {fault}")
    return CameraMessage(camera)


def _read_frame(data: bytes) -> FrameMessage:
    stamp, camera, boxes, labels, scores, depths, tracks, *whole = json.loads(data[1:])
    if whole not in ([], [True]):
        raise ValueError("the frame has too many fields")
    count = len(labels)
    corners, score, depth = as_array(boxes, (count, 4)), as_array(scores, (count,)), as_array(depths, (count,))
    for fine, reason in box_rules(corners, score, np.array([is_name(label) for label in labels], dtype=bool)):
        if not fine.all():
            raise ValueError(reason)
    depth = np.where(valid_depths(depth), depth, np.nan)
    track = np.array(tracks, dtype=np.int64).reshape(count)
    return FrameMessage(as_stamp(stamp), as_name(camera), corners, tuple(labels), score, depth, track, bool(whole))


_READERS: dict[bytes, Callable[[bytes], Message]] = {
    **dict.fromkeys(_PATHS, _read_pose),
    _MOUNT_KIND: _read_mount,
    _NOTE_KIND: _read_note,
    **CORRECTION_READERS,
    _CAMERA_KIND: _read_camera,
    _FRAME_KIND: _read_frame,
}
