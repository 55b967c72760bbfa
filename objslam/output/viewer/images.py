"""Make the camera images of a recording: a limited number of small JPEGs, which threads read in advance."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Images, Log
from objslam.errors import LogError
from objslam.frontend.box_depths import nearest_stamps
from objslam.io.images import decode_colour
from objslam.io.text import read_bytes
from objslam.io.threads import ahead
from objslam.output.plot.style import evenly

_MAX_LAG = 0.05  # The longest time, s, between a keyframe and its image.
_QUALITY = 70  # The quality of JPEGs, 0 to 100. A larger value makes larger recordings.
_AHEAD = 8  # The number of images that threads read in advance. A larger value takes more memory.


def choose_images(images: Images, stamps: Floats, most: int) -> tuple[Ints, Ints]:
    """Choose at most `most` of the stamps (N,), s, that have an image within `_MAX_LAG`, evenly spread.

    Return the indices (n,) of these stamps and the indices (n,) of their images.
    """
    if most == 0 or len(stamps) == 0 or len(images.paths) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = nearest_stamps(images.stamps, stamps)
    shown = np.flatnonzero(np.abs(images.stamps[near] - stamps) <= _MAX_LAG)
    shown = shown[evenly(len(shown), most)]
    return shown, near[shown]


def of_log(log: Log) -> Callable[[str, float], NDArray[np.uint8] | None]:
    """Return a function that takes a camera's name and a stamp, s, and returns an image (H, W, 3), uint8 BGR, or None."""
    streams = {c.camera.name: c.rgb for c in log.cameras if c.rgb is not None}

    def find(camera: str, stamp: float) -> NDArray[np.uint8] | None:
        images = streams.get(camera)
        if images is None:
            return None
        _, which = choose_images(images, np.array([stamp]), 1)
        return _read(images.paths[which[0]]) if len(which) else None

    return find


def jpegs(images: Images, which: Ints, width: int, height: int) -> Iterator[bytes | None]:
    """Yield the images with the indices `which` as JPEGs of the given size, px. Yield None for an unreadable image."""

    def jpeg(index: int) -> bytes | None:
        pixels = _read(images.paths[index])
        return None if pixels is None else pack(pixels, (width, height))

    return ahead(jpeg, which.tolist(), _AHEAD)


def _read(path: Path) -> NDArray[np.uint8] | None:
    try:
        return decode_colour(read_bytes(path))
    except LogError:
        return None


def pack(pixels: np.ndarray, size: tuple[int, int] | None = None) -> bytes:
    """Return an image (H, W, 3), uint8 BGR, or (H, W) as a JPEG. size: the width and height of the JPEG, px. None keeps the
    size of the image."""
    import cv2

    if size is not None and (pixels.shape[1], pixels.shape[0]) != size:
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()
