"""Pictures of an object: its best boxes, cut out of the log's images while these are still there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.types import Images
from objslam.errors import ObjslamError
from objslam.frontend.box_depths import MAX_IMAGE_LAG, nearest_stamps
from objslam.io.images import decode_colour
from objslam.io.rays_parquet import RaysTable
from objslam.io.text import read_bytes
from objslam.output.plot.style import REJECTED_BELOW
from objslam.sources import SourceOptions, read

_SIDE = 160  # The longer side of a picture on the page, px.
_MARGIN = 0.2  # What is shown around a box on each side, as a share of its longer side.
_MIN_SIDE = 40  # The least part of an image that is shown, px.
_FRAME = (60, 190, 255)  # The colour of the box, BGR: orange.


@dataclass(frozen=True)
class Crop:
    """What a box shows."""

    jpeg: bytes
    width: int  # px.
    height: int  # px.
    stamp: float  # Of the ray, s.
    score: float  # Of the box.
    camera: str


def images_of(path: object, count: int | None) -> tuple[dict[str, Images], str | None]:
    """The images of a log by camera, or, where there are none, the reason in words.

    Args:
        path: the log; what is no path means that nobody knows where it is.
        count: the number of images when the log was mapped; None where nobody knows.
    """
    if count == 0:
        return {}, "The log has no images."
    if not isinstance(path, str | Path):
        return {}, "The result does not say which log it is from."
    log = Path(path)
    if not log.exists():
        return {}, f"The log is not at {log} any more: objslam report --log LOG says where it is."
    try:
        cameras = read(log, Ledger(), SourceOptions(with_range=False, with_images=False)).cameras
    except ObjslamError as error:
        return {}, f"The log cannot be read again: {error}"
    images = {c.camera.name: c.rgb for c in cameras if c.rgb is not None}
    return images, None if images else "The log has no images."


def best_rays(rays: RaysTable, mine: Ints, count: int) -> Ints:
    """The best of an object's used rays: one, by score and size, in each of `count` parts of the time that it was seen.

    Args:
        mine: (M,) indices of the object's rays, in the order of time.
    """
    kept = mine[rays.weight[mine] >= REJECTED_BELOW]
    parts = np.array_split(kept, min(count, len(kept))) if count and len(kept) else []
    size = np.sqrt(np.prod(rays.box[:, 2:] - rays.box[:, :2], axis=1))
    return np.array([part[np.lexsort((size[part], rays.score[part]))[-1]] for part in parts], dtype=np.int64)


def cut_crops(
    rays: RaysTable, chosen: Ints, images: dict[str, Images], progress: Callable[[int, int], None]
) -> dict[int, Crop]:
    """The pictures of the chosen rays (C,), by ray; a ray without a readable image at its time has none."""
    files = {int(i): file for i in chosen if (file := _file(rays, int(i), images)) is not None}
    by_file: dict[Path, list[int]] = {}
    for ray, file in files.items():
        by_file.setdefault(file, []).append(ray)
    crops = {}
    for done, (file, wanted) in enumerate(by_file.items()):
        try:
            image = decode_colour(read_bytes(file))
        except ObjslamError:
            image = None
        for ray in wanted if image is not None else ():
            picture = _cut(image, rays.box[ray])
            if picture is not None:
                jpeg, width, height = picture
                crops[ray] = Crop(jpeg, width, height, float(rays.stamp[ray]), float(rays.score[ray]), str(rays.camera[ray]))
        progress(done + 1, len(by_file))
    return crops


def _file(rays: RaysTable, ray: int, images: dict[str, Images]) -> Path | None:
    listed = images.get(str(rays.camera[ray]))
    if listed is None:
        return None
    index = int(nearest_stamps(listed.stamps, rays.stamp[ray : ray + 1])[0])
    return listed.paths[index] if abs(listed.stamps[index] - rays.stamp[ray]) <= MAX_IMAGE_LAG else None


def _cut(image: Any, box: Floats) -> tuple[bytes, int, int] | None:
    """A square around a box, with the box in it, as JPEG with its width and height; None for a box outside the image."""
    import cv2

    height, width = image.shape[:2]
    middle, longer = (box[:2] + box[2:]) / 2, float((box[2:] - box[:2]).max())
    half = max((0.5 + _MARGIN) * longer, _MIN_SIDE / 2)
    low = np.clip(np.floor(middle - half), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(middle + half), 0, [width, height]).astype(int)
    if (high - low < 2).any():
        return None
    part = image[low[1] : high[1], low[0] : high[0]]
    scale = _SIDE / max(part.shape[:2])
    shape = max(round(part.shape[1] * scale), 1), max(round(part.shape[0] * scale), 1)
    part = cv2.resize(part, shape, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    corners = np.rint((box.reshape(2, 2) - low) * scale).astype(int)
    cv2.rectangle(part, corners[0].tolist(), corners[1].tolist(), _FRAME, 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes(), shape[0], shape[1]
