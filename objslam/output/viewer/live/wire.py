"""Messages from a session to the process that draws it: JSON, followed by the images."""

from __future__ import annotations

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

_LENGTH = struct.Struct("<Q")  # The length of the JSON text, bytes, with which a message begins.
_MAX_POINTS = 500  # The largest number of points of the path that a message carries.
_MAX_LENGTH = 1 << 30  # The longest text, bytes, that is read: a damaged length must not fill the memory.


@dataclass(frozen=True)
class ShownSnapshot:
    """What is drawn of a snapshot."""

    stamp: float  # Of the newest keyframe, s; NaN before the first.
    map: ObjectMap
    path: Floats  # (n, 3) m, positions of the base in map, thinned.
    base: Floats | None  # (4, 4) the newest map_T_base; None before the first.
    numbers: dict[str, float]  # Keyframes, rebuilds, times in s, and the snapshots that the viewer missed ("unseen").
    counters: dict[str, int]  # Accepted messages by kind.
    dropped: dict[str, int]  # Dropped messages by reason.


def encode_snapshot(snapshot: Snapshot, unseen: int = 0) -> bytes:
    """A snapshot as one message; unseen: the number of snapshots that were dropped before it."""
    frames, path = snapshot.frames, snapshot.path
    p50, p99 = snapshot.update
    numbers = {"lag": snapshot.lag, "p50": p50, "p99": p99, "unseen": unseen}
    numbers |= {"keyframes": snapshot.keyframes, "rebuilds": snapshot.rebuilds}
    head: dict[str, Any] = {
        "stamp": snapshot.stamp,
        "map": json.loads(dump_objects(snapshot.map)),
        "path": path.poses[evenly(len(path), _MAX_POINTS), :3, 3].round(4).tolist(),
        "base": path.poses[-1].tolist() if len(path) else None,
        "numbers": {name: float(value) for name, value in numbers.items()},
        "counters": {name: int(n) for name, n in snapshot.counters.items()},
        "dropped": {name: int(n) for name, n in snapshot.dropped.items()},
        "frames": [_frame(f) for f in frames],
    }
    blobs = [b"" if f.image is None else f.image if isinstance(f.image, bytes) else _packed(f.image) for f in frames]
    head["blobs"] = [len(b) for b in blobs]
    text = json.dumps(head).encode()
    return _LENGTH.pack(len(text)) + text + b"".join(blobs)


def read_snapshot(stream: BinaryIO) -> tuple[ShownSnapshot, list[CameraFrame]] | None:
    """The next message of a stream, and the frames that came with it; None at its end or where it is cut off."""
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
    shown = ShownSnapshot(
        stamp=head["stamp"],
        map=parse_objects(head["map"]),
        path=np.array(head["path"]).reshape(-1, 3),
        base=None if head["base"] is None else np.array(head["base"]),
        numbers=head["numbers"],
        counters=head["counters"],
        dropped=head["dropped"],
    )
    return shown, [_parse_frame(f, b) for f, b in zip(head["frames"], blobs, strict=True)]


def _frame(f: CameraFrame) -> dict[str, Any]:
    c = f.camera
    return {
        "stamp": f.stamp,
        "camera": {
            "name": c.name,
            "width": c.width,
            "height": c.height,
            "matrix": c.matrix.tolist(),
            "distortion_model": c.distortion_model,
            "distortion": c.distortion.tolist(),
        },
        "map_T_camera": f.map_T_camera.tolist(),
        "boxes": f.boxes.tolist(),
        "objects": f.objects.tolist(),
        "rejected": f.rejected.tolist(),
    }


def _parse_frame(entry: dict[str, Any], blob: bytes) -> CameraFrame:
    camera = dict(entry["camera"])
    for name in ("matrix", "distortion"):
        camera[name] = np.array(camera[name])
    return CameraFrame(
        stamp=entry["stamp"],
        camera=Camera(**camera),
        map_T_camera=np.array(entry["map_T_camera"]),
        boxes=np.array(entry["boxes"]).reshape(-1, 4),
        objects=np.array(entry["objects"], dtype=np.int64),
        rejected=np.array(entry["rejected"], dtype=bool),
        image=blob or None,
    )


def _packed(pixels: np.ndarray) -> bytes:
    from objslam.output.viewer.images import pack

    return pack(pixels, (pixels.shape[1], pixels.shape[0]))
