"""Camera images for a recording: few, small and as JPEG, read ahead in threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Images, Log
from objslam.errors import LogError
from objslam.io.images import decode_colour
from objslam.io.prefetch import ahead
from objslam.io.text import read_bytes
from objslam.output.plot.style import evenly

_MAX_LAG = 0.05  # The longest time, s, between a keyframe and the image that is shown for it.
_QUALITY = 70  # The quality of JPEGs, 0 to 100; larger values make larger recordings.
_AHEAD = 8  # The number of images that are read ahead; larger values take more memory.


def choose_images(images: Images, stamps: Floats, most: int) -> tuple[Ints, Ints]:
    """Which of the stamps (N,), s, get an image, at most `most` and evenly spread, and the index of each one's image."""
    if most == 0 or len(stamps) == 0 or len(images.paths) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    after = np.clip(np.searchsorted(images.stamps, stamps), 1, max(len(images.stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(images.stamps) - 1)
    near = np.where(np.abs(images.stamps[before] - stamps) <= np.abs(images.stamps[after] - stamps), before, after)
    there = np.flatnonzero(np.abs(images.stamps[near] - stamps) <= _MAX_LAG)
    there = there[evenly(len(there), most)]
    return there, near[there]


def of_log(log: Log) -> Callable[[str, float], NDArray[np.uint8] | None]:
    """A function that finds a log's image (H, W, 3), uint8 BGR, by the camera's name and a stamp, s; None without one."""
    streams = {c.camera.name: c.rgb for c in log.cameras if c.rgb is not None}

    def find(camera: str, stamp: float) -> NDArray[np.uint8] | None:
        images = streams.get(camera)
        if images is None:
            return None
        _, which = choose_images(images, np.array([stamp]), 1)
        return _read(images.paths[which[0]]) if len(which) else None

    return find


def jpegs(images: Images, which: Ints, width: int, height: int) -> Iterator[bytes | None]:
    """The chosen images as JPEG of a size, px, one after the other; None for an image that cannot be read."""
    return ahead(lambda i: _jpeg(images, int(i), (width, height)), which.tolist(), _AHEAD)


def _jpeg(images: Images, index: int, size: tuple[int, int]) -> bytes | None:
    pixels = _read(images.paths[index])
    return None if pixels is None else pack(pixels, size)


def _read(path: Path) -> NDArray[np.uint8] | None:
    try:
        return decode_colour(read_bytes(path))
    except LogError:
        return None


def pack(pixels: np.ndarray, size: tuple[int, int]) -> bytes:
    """Pixels (H, W, 3) uint8 BGR, or (H, W), as JPEG of a size (width, height)."""
    import cv2

    if (pixels.shape[1], pixels.shape[0]) != size:
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()
