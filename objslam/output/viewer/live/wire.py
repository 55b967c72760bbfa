"""Write and read the messages from a session to its view process. A message is JSON, followed by the images."""

import json
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.snapshot import CameraFrame, Snapshot
from objslam.io.objects_json import dump_objects, parse_objects
from objslam.output.plot.style import evenly
from objslam.output.viewer.images import pack

_LENGTH = struct.Struct("<Q")  # The first bytes of a message: the length of its JSON text, bytes.
_MAX_POINTS = 500  # The largest number of points of the path in a message.
_MAX_LENGTH = 1 << 30  # The largest length of a text that is read, bytes. A damaged length then does not fill the memory.
_CAMERA = ("name", "width", "height", "matrix", "distortion_model", "distortion")  # The fields of a camera in a message.
_FRAME = ("stamp", "map_T_camera", "boxes", "objects", "rejected")  # The fields of a frame in a message.


@dataclass(frozen=True)
class ShownSnapshot:
    """The part of a snapshot that the view shows."""

    stamp: float  # The stamp of the newest keyframe, s. NaN without keyframes.
    map: ObjectMap
    path: Floats  # (n, 3) positions of the base, m in map, evenly chosen.
    base: Floats | None  # (4, 4) the newest map_T_base. None without keyframes.
    numbers: dict[str, float]  # Counts: keyframes, rebuilds, unseen snapshots. Times, s: lag; p50, p99 of an update.
    counters: dict[str, int]  # The number of accepted messages by kind.
    dropped: dict[str, int]  # The number of dropped messages by reason.


def encode_snapshot(snapshot: Snapshot, unseen: int = 0) -> bytes:
    """Return a snapshot as one message. unseen: the number of snapshots that were dropped before this one."""
    frames, path, (p50, p99) = snapshot.frames, snapshot.path, snapshot.update
    numbers = {"lag": snapshot.lag, "p50": p50, "p99": p99, "unseen": unseen}
    numbers |= {"keyframes": snapshot.keyframes, "rebuilds": snapshot.rebuilds}
    head: dict[str, Any] = {
        "stamp": snapshot.stamp,
        "map": json.loads(dump_objects(snapshot.map)),
        "path": path.poses[evenly(len(path), _MAX_POINTS), :3, 3].round(4),
        "base": path.poses[-1] if len(path) else None,
        "numbers": {name: float(value) for name, value in numbers.items()},
        "counters": {name: int(n) for name, n in snapshot.counters.items()},
        "dropped": {name: int(n) for name, n in snapshot.dropped.items()},
        "frames": [_fields(f, _FRAME) | {"camera": _fields(f.camera, _CAMERA)} for f in frames],
    }
    blobs = [pack(f.image) if isinstance(f.image, np.ndarray) else f.image or b"" for f in frames]
    head["blobs"] = [len(b) for b in blobs]
    text = json.dumps(head, default=np.ndarray.tolist).encode()
    return _LENGTH.pack(len(text)) + text + b"".join(blobs)


def read_snapshot(stream: BinaryIO) -> tuple[ShownSnapshot, list[CameraFrame]] | None:
    """Return the snapshot and the camera frames of a stream's next message. Return None at the end of the stream, or if the
    message is cut off."""
    start = stream.read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    text = stream.read(min(length, _MAX_LENGTH))
    if len(text) < length:
        return None
    head = json.loads(text)
    blobs = [stream.read(n) for n in head["blobs"]]
    if [len(b) for b in blobs] != head["blobs"]:
        return None
    path, base = np.array(head["path"]).reshape(-1, 3), None if head["base"] is None else np.array(head["base"])
    counts = head["numbers"], head["counters"], head["dropped"]
    shown = ShownSnapshot(head["stamp"], parse_objects(head["map"]), path, base, *counts)
    return shown, [_parse_frame(f, b) for f, b in zip(head["frames"], blobs, strict=True)]


def _fields(of: CameraFrame | Camera, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}


def _parse_frame(entry: dict[str, Any], blob: bytes) -> CameraFrame:
    arrays = {name: np.array(entry["camera"][name]) for name in ("matrix", "distortion")}
    return CameraFrame(
        stamp=entry["stamp"],
        camera=Camera(**entry["camera"] | arrays),
        map_T_camera=np.array(entry["map_T_camera"]),
        boxes=np.array(entry["boxes"]).reshape(-1, 4),
        objects=np.array(entry["objects"], dtype=np.int64),
        rejected=np.array(entry["rejected"], dtype=bool),
        image=blob or None,
    )
