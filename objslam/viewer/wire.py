"""What a live view's two processes say to each other: JSON, with the images behind it."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from objslam.live.interface import Frame, Snapshot
from objslam.objects_file import dump_objects, parse_objects
from objslam.types import Camera, Floats, ObjectMap
from objslam.viewer.paths import thinned

_LENGTH = struct.Struct("<Q")
_MOST_POINTS = 500  # of the path
_LARGEST = 1 << 30


@dataclass(frozen=True)
class Shown:
    """A snapshot as it arrives: what of it is drawn. path: (n, 3) m, thinned. base: (4, 4) the newest pose, or None."""

    stamp: float
    map: ObjectMap
    path: Floats
    base: Floats | None
    numbers: dict[str, float]
    counters: dict[str, int]
    dropped: dict[str, int]


def encode(snapshot: Snapshot, unseen: int = 0) -> bytes:
    """A snapshot as one message; unseen: snapshots that were dropped before it."""
    frames = snapshot.frames
    numbers = {
        "keyframes": snapshot.keyframes,
        "rebuilds": snapshot.rebuilds,
        "lag": snapshot.lag,
        "p50": snapshot.update[0],
        "p99": snapshot.update[1],
        "unseen": unseen,
    }
    head: dict[str, Any] = {
        "stamp": snapshot.stamp,
        "map": json.loads(dump_objects(snapshot.map)),
        "path": thinned(snapshot.path, _MOST_POINTS).round(4).tolist(),
        "base": snapshot.path.poses[-1].tolist() if len(snapshot.path) else None,
        "numbers": {name: float(value) for name, value in numbers.items()},
        "counters": {name: int(n) for name, n in snapshot.counters.items()},
        "dropped": {name: int(n) for name, n in snapshot.dropped.items()},
        "frames": [_frame(f) for f in frames],
    }
    blobs = [b"" if f.image is None else f.image if isinstance(f.image, bytes) else _packed(f.image) for f in frames]
    head["blobs"] = [len(b) for b in blobs]
    text = json.dumps(head).encode()
    return _LENGTH.pack(len(text)) + text + b"".join(blobs)


def read(stream: BinaryIO) -> tuple[Shown, list[Frame]] | None:
    """The next message of a stream, None at its end or where it is cut off."""
    start = stream.read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    text = stream.read(min(length, _LARGEST))
    if len(text) < length:
        return None
    head = json.loads(text)
    blobs = [stream.read(n) for n in head["blobs"]]
    if [len(b) for b in blobs] != head["blobs"]:
        return None
    shown = Shown(
        stamp=head["stamp"],
        map=parse_objects(head["map"]),
        path=np.array(head["path"]).reshape(-1, 3),
        base=None if head["base"] is None else np.array(head["base"]),
        numbers=head["numbers"],
        counters=head["counters"],
        dropped=head["dropped"],
    )
    return shown, [_parse_frame(f, b) for f, b in zip(head["frames"], blobs, strict=True)]


def _frame(f: Frame) -> dict[str, Any]:
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


def _parse_frame(entry: dict[str, Any], blob: bytes) -> Frame:
    camera = dict(entry["camera"])
    for name in ("matrix", "distortion"):
        camera[name] = np.array(camera[name])
    return Frame(
        stamp=entry["stamp"],
        camera=Camera(**camera),
        map_T_camera=np.array(entry["map_T_camera"]),
        boxes=np.array(entry["boxes"]).reshape(-1, 4),
        objects=np.array(entry["objects"], dtype=np.int64),
        rejected=np.array(entry["rejected"], dtype=bool),
        image=blob or None,
    )


def _packed(pixels: np.ndarray) -> bytes:
    from objslam.viewer.images import pack

    return pack(pixels, (pixels.shape[1], pixels.shape[0]))
