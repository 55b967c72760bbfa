"""The images of a camera, read and decoded ahead of the network in threads of their own."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from objslam.detection.cache import DetectionCache
from objslam.detection.detector import Boxes
from objslam.detection.network import Array
from objslam.errors import LogError
from objslam.sources.textfile import read_bytes
from objslam.types import Camera

_In = TypeVar("_In")
_Out = TypeVar("_Out")

_THREADS = 2  # a PNG takes longer to decode than a network on a GPU takes


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
    image = decode_image(data)
    if image is None:
        return Frame(digest, problem="rgb image that cannot be decoded", where=str(path))
    problem, where = _wrong_size(image.shape[1], image.shape[0], path, camera)
    return Frame(digest, image, problem=problem, where=where)


def decode_image(data: bytes) -> Array | None:
    """An image file's content as (H, W, 3) uint8 BGR, None where it is no image or a damaged one."""
    import cv2

    try:
        image: Array | None = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        return None
    return image


def ahead(work: Callable[[_In], _Out], items: Iterable[_In], depth: int) -> Iterator[_Out]:
    """work(item) for each item, in order, done in threads that are at most `depth` items ahead."""
    waiting: deque[Future[_Out]] = deque()
    pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="objslam-images")
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _wrong_size(width: int, height: int, path: Path, camera: Camera) -> tuple[str | None, str]:
    if (width, height) == (camera.width, camera.height):
        return None, ""
    return (
        "rgb image that has not the camera's size",
        f"{path} is {width}x{height}, the camera {camera.width}x{camera.height}",
    )
