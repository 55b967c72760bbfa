"""Read the depths of boxes from depth images."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.core.types import Detections, Images
from objslam.errors import LogError
from objslam.io.images import decode_depth
from objslam.io.text import read_bytes

_CENTRE_SHARE = 0.5
"""The share of a box's width, and of its height, in which depth is read. A larger share includes background at the edge."""
_MIN_VALID_SHARE = 0.1
"""The least share of valid pixels for a depth to be read. A larger share leaves more boxes without a depth."""
_LEAST_SHOWN = 0.1
"""The least share of the valid pixels that must show the thing, if the other pixels show the background. With a larger
share, thin things, such as a tripod, get the depth of the wall behind them. With a smaller share, a box gets the depth of a
thing that hides only a strip of its own thing."""
_APART = 4.0
"""The least distance between the depths of two different surfaces, in standard deviations of the nearer depths. The two
halves of one Gaussian are 2.3 apart, and the two halves of a sloping plane are 2.7 apart. With a larger number, fewer
backgrounds are found."""
MAX_IMAGE_LAG = 0.02
"""The longest time (s) between the stamps of the colour image and the depth image of one frame. Some cameras give the two
images different stamps. A longer time pairs images of different moments."""


def depths_at_boxes(detections: Detections, images: Images, camera: Camera, ledger: Ledger) -> Detections:
    """Return the detections with the depth (m) of each box, from the depth image that is nearest in time.

    An unknown depth is NaN. The depth images must be registered to the camera's image. The ledger counts depth images that
    cannot be used, and frames with boxes that have no depth image within `MAX_IMAGE_LAG`.
    """
    depths = np.full(len(detections), np.nan)
    frames, start, count = np.unique(detections.frame, return_index=True, return_counts=True)
    stamps = detections.frame_stamps[frames]
    closest = nearest_stamps(images.stamps, stamps)
    near = np.abs(images.stamps[closest] - stamps) <= MAX_IMAGE_LAG
    if not near.all():
        ledger.drop("depth of a frame without a depth image", int((~near).sum()), f"stamp {stamps[~near][0]:.3f}")
    for index, first, boxes in zip(closest[near].tolist(), start[near].tolist(), count[near].tolist(), strict=True):
        image = read_depth(images.paths[index], camera, ledger)
        if image is not None:
            mine, focal = slice(first, first + boxes), float(camera.matrix[0, 0])
            depths[mine] = [box_depth(image, box, focal) / camera.depth_scale for box in detections.boxes[mine]]
    return replace(detections, depths=depths)


def box_depth(image: NDArray[Any], box: Floats, focal: float) -> float:
    """Return the median depth of the thing in the central half of a box (x1, y1, x2, y2) px, in the image's units.

    The central half has half the width and half the height. Only finite depths above zero are valid. If fewer than a tenth
    of the pixels are valid, the result is NaN. Pixels that show what is behind a thin or hollow thing do not count. focal:
    px, the focal length of the image.
    """
    height, width = image.shape
    middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) * _CENTRE_SHARE / 2
    low = np.clip(np.floor(middle - half), 0, [width - 1, height - 1]).astype(int)
    high = np.clip(np.ceil(middle + half), low + 1, [width, height]).astype(int)
    part = image[low[1] : high[1], low[0] : high[0]]
    valid = part[np.isfinite(part) & (part > 0)]
    if not valid.size or valid.size < _MIN_VALID_SHARE * part.size:
        return np.nan
    return float(np.median(_of_thing(valid.astype(np.float64), 2 * float(half.max()) / _CENTRE_SHARE / focal)))


def _of_thing(depths: Floats, size: float) -> Floats:
    """Return the depths, among depths (n,), that belong to the nearest surface.

    A thing may be as deep as it is wide or high. Larger depths are background, if a gap separates them from the thing. size:
    the larger side of the thing, per unit of its depth.
    """
    least = _LEAST_SHOWN * len(depths)
    while True:
        near = depths <= np.quantile(depths, [0.1, 0.9]).mean()
        if near.all() or near.sum() < least:
            return depths
        here, behind = np.median(depths[near]), np.median(depths[~near])
        spread = np.median(np.abs(depths[near] - here)) / NORMAL_MEDIAN
        if behind - here <= max(size * here, _APART * spread):
            return depths
        depths = depths[near]


def nearest_stamps(stamps: Floats, query: Floats) -> NDArray[np.int64]:
    """Return for each stamp in `query` (Q,) the index of the nearest one among the increasing `stamps` (N,)."""
    after = np.clip(np.searchsorted(stamps, query), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps[before] - query) <= np.abs(stamps[after] - query), before, after)


def read_depth(path: Path, camera: Camera, ledger: Ledger) -> NDArray[Any] | None:
    """Read a depth image (H, W) in its own units.

    If the image cannot be decoded or does not have the camera's size, the ledger counts it, and the result is None.
    """
    try:
        image = decode_depth(read_bytes(path))
    except LogError:
        image = None
    if image is None:
        ledger.drop("depth image that cannot be decoded", where=str(path))
    elif image.shape != (camera.height, camera.width):
        ledger.drop("depth image that is in colour or does not have the camera's size", where=str(path))
        return None
    return image
