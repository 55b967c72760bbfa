"""Reading and decoding of the images of a camera, to be run in threads ahead of the network."""

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
    """Hold one image file: its pixels, its boxes from the cache, or its problem with the place of the problem."""

    digest: str = ""
    image: Array | None = None
    known: Boxes | None = None
    problem: str | None = None
    where: str = ""


def load_frame(path: Path, camera: Camera, cache: DetectionCache | None) -> Frame:
    """Read an image file, and decode it to 8 bit BGR without EXIF rotation unless the cache has its boxes."""
    try:
        data = read_bytes(path)
    except LogError as error:
        return Frame(problem="rgb image that cannot be read", where=str(error))
    digest = hashlib.sha256(data).hexdigest()
    image, entry = None, None if cache is None else cache.read(digest)
    if entry is not None:
        width, height = entry.width, entry.height
    elif (image := decode_colour(data)) is not None:
        height, width = image.shape[:2]
    else:
        return Frame(digest, problem="rgb image that cannot be decoded", where=str(path))
    if (width, height) != (camera.width, camera.height):
        where = f"{path} is {width}x{height}, the camera {camera.width}x{camera.height}"
        return Frame(digest, problem="rgb image that has not the camera's size", where=where)
    return Frame(digest, image, None if entry is None else entry.boxes)
