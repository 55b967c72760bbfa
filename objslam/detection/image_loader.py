"""The images of a camera, read and decoded ahead of the network in threads of their own."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from objslam.core.arrays import Array
from objslam.core.camera import Camera
from objslam.detection.cache import DetectionCache
from objslam.detection.detector import Boxes
from objslam.errors import LogError
from objslam.io.images import decode_colour
from objslam.io.text import read_bytes


@dataclass(frozen=True)
class Frame:
    """One image file: its pixels, or what the cache knows of it, or the problem with it (and where that is)."""

    digest: str = ""
    image: Array | None = None
    known: Boxes | None = None
    problem: str | None = None
    where: str = ""


def load_frame(path: Path, camera: Camera, cache: DetectionCache | None) -> Frame:
    """Read an image file, and decode it (8 bit, BGR, as the sensor has it: no EXIF rotation) unless the cache knows it."""
    try:
        data = read_bytes(path)
    except LogError as error:
        return Frame(problem="rgb image that cannot be read", where=str(error))
    digest = hashlib.sha256(data).hexdigest()
    entry = None if cache is None else cache.read(digest)
    if entry is not None:
        problem, where = _wrong_size(entry.width, entry.height, path, camera)
        return Frame(digest, known=entry.boxes, problem=problem, where=where)
    image = decode_colour(data)
    if image is None:
        return Frame(digest, problem="rgb image that cannot be decoded", where=str(path))
    problem, where = _wrong_size(image.shape[1], image.shape[0], path, camera)
    return Frame(digest, image, problem=problem, where=where)


def _wrong_size(width: int, height: int, path: Path, camera: Camera) -> tuple[str | None, str]:
    if (width, height) == (camera.width, camera.height):
        return None, ""
    return (
        "rgb image that has not the camera's size",
        f"{path} is {width}x{height}, the camera {camera.width}x{camera.height}",
    )
