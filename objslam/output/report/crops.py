"""Make the pictures of the page. They are crops of chosen boxes from the images of the log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.types import Images
from objslam.errors import ObjslamError
from objslam.frontend.box_depths import MAX_IMAGE_LAG, nearest_stamps
from objslam.io.images import decode_colour
from objslam.io.rays_parquet import RaysTable
from objslam.io.text import read_bytes
from objslam.output.plot.style import REJECTED_BELOW, evenly
from objslam.sources import SourceOptions, read

_SIDE = 160  # The longer side of a crop on the page, px. A larger value shows more detail, and makes the page larger.
_MARGIN = 0.2  # The margin of a crop on each side of the box, as a share of the box's longer side.
_MIN_SIDE = 40  # The least side of the part of the image that a crop shows, px.
_FRAME, _REJECTED_FRAME = (60, 190, 255), (60, 60, 235)
"""The BGR colours of drawn boxes: orange, and red for a box whose ray was rejected."""
Kind = Literal["best", "worst", "rejected", "unexplained"]


@dataclass(frozen=True)
class Crop:
    """A part of an image that shows one box."""

    jpeg: bytes
    width: int  # px.
    height: int  # px.
    stamp: float  # The stamp of the ray, s.
    score: float  # The score of the box.
    camera: str
    residual_deg: float  # The angle between the ray and its object, NaN without an object.
    kind: Kind  # Why the box was chosen. "unexplained": its ray belongs to no object.


def images_of(path: object, count: int | None) -> tuple[dict[str, Images], str | None]:
    """Return the images of a log by camera name, and a sentence with the reason why the log has no images.

    The sentence is None if the log has images.

    Args:
        path: the path of the log. A value that is neither a str nor a Path means that the path is unknown.
        count: the number of images that the log had at the time of the run, None if this is unknown.
    """
    if count == 0:
        return {}, "The log of the run had no images."
    if not isinstance(path, str | Path):
        return {}, "The result does not name its log: name it with objslam report --log LOG."
    log = Path(path)
    if not log.exists():
        return {}, f"The log is not at {log} any more: name its new path with objslam report --log LOG."
    try:
        cameras = read(log, Ledger(), SourceOptions(with_range=False, with_images=False)).cameras
    except ObjslamError as error:
        return {}, f"The log cannot be read again: {error}"
    images = {c.camera.name: c.rgb for c in cameras if c.rgb is not None}
    if images:
        return images, None
    had = "" if count is None else f", but the log of the run had {count}: name that one with objslam report --log LOG"
    return {}, f"The log at {log} has no images{had}."


def best_rays(rays: RaysTable, mine: Ints, count: int) -> Ints:
    """Return the indices of at most `count` used rays of an object, the best ones.

    The used rays are split into `count` parts in the order of time. The best ray of each part has the highest score. Of
    equal scores, the ray with the largest box is the best.

    Args:
        mine: (M,) the indices of the object's rays, in the order of time.
    """
    kept = mine[rays.weight[mine] >= REJECTED_BELOW]
    parts = np.array_split(kept, min(count, len(kept))) if count and len(kept) else []
    size = np.sqrt(np.prod(rays.box[:, 2:] - rays.box[:, :2], axis=1))
    return np.array([part[np.lexsort((size[part], rays.score[part]))[-1]] for part in parts], dtype=np.int64)


def choose_rays(rays: RaysTable, mine: Ints, count: int) -> dict[int, Kind]:
    """Return the indices of the rays for the pictures of an object, each with its kind.

    best: up to `count` rays from `best_rays`. worst: the other used rays with the largest residuals, in standard deviations.
    rejected: rejected rays, evenly chosen. The worst rays are at most half of `count`, rounded up, and so are the rejected
    rays. mine: (M,) the indices of the object's rays, in the order of time.
    """
    found: dict[int, Kind] = dict.fromkeys(best_rays(rays, mine, count).tolist(), "best")
    few = (count + 1) // 2 if count else 0
    used = rays.weight[mine] >= REJECTED_BELOW
    kept = [ray for ray in mine[used].tolist() if ray not in found]
    off = np.nan_to_num(rays.residual / rays.sigma)
    found |= dict.fromkeys(sorted(kept, key=lambda ray: -off[ray])[:few], "worst")
    return found | dict.fromkeys(mine[~used][evenly(int((~used).sum()), few)].tolist(), "rejected")


def choose_unexplained(rays: RaysTable, label: str, count: int) -> dict[int, Kind]:
    """Return the indices of up to `count` rays of a label that belong to no object, spread over the time."""
    return spread_over_time(rays, np.flatnonzero((rays.object < 0) & (rays.label == label)), count)


def spread_over_time(rays: RaysTable, mine: Ints, count: int) -> dict[int, Kind]:
    """Return up to `count` of the ray indices `mine` (M,), spread over the time, each with the kind "unexplained".

    The rays are split into `count` parts in the order of time. The ray with the highest score is taken from each part.
    """
    most = min(count, len(mine))
    parts = np.array_split(mine[np.argsort(rays.stamp[mine], kind="stable")], most) if most else []
    return {int(part[np.argmax(rays.score[part])]): "unexplained" for part in parts}


def cut_crops(
    rays: RaysTable, chosen: dict[int, Kind], images: dict[str, Images], progress: Callable[[int, int], None]
) -> dict[int, Crop]:
    """Return the crops of the rays in `chosen`, by the index of the ray.

    A ray has no crop if no readable image is within `MAX_IMAGE_LAG` (s) of its frame, or if its box is outside the image.
    progress: a function that gets the number of image files that are done, and the number of all image files.
    """
    by_file: dict[Path, list[int]] = {}
    for ray in chosen:
        listed = images.get(str(rays.camera[ray]))
        if listed is not None:
            near = int(nearest_stamps(listed.stamps, rays.frame_stamp[ray : ray + 1])[0])
            if abs(listed.stamps[near] - rays.frame_stamp[ray]) <= MAX_IMAGE_LAG:
                by_file.setdefault(listed.paths[near], []).append(ray)
    crops = {}
    for done, (file, wanted) in enumerate(by_file.items()):
        try:
            image = decode_colour(read_bytes(file))
        except ObjslamError:
            image = None
        for ray in wanted if image is not None else ():
            picture = _cut(image, rays.box[ray], _REJECTED_FRAME if chosen[ray] == "rejected" else _FRAME)
            if picture is not None:
                off = float(np.degrees(rays.residual[ray]))
                stamp, score = float(rays.stamp[ray]), float(rays.score[ray])
                crops[ray] = Crop(*picture, stamp, score, str(rays.camera[ray]), off, chosen[ray])
        progress(done + 1, len(by_file))
    return crops


def _cut(image: Any, box: Floats, colour: tuple[int, int, int]) -> tuple[bytes, int, int] | None:
    """Cut the square around a box out of an image, and draw the box on it.

    Returns the JPEG data, the width and the height, px, or None if the box is outside the image.
    """
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
    cv2.rectangle(part, corners[0].tolist(), corners[1].tolist(), colour, 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes(), shape[0], shape[1]
