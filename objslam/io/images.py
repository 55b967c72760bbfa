"""Packed images (PNG, JPEG, TIFF, ...) as pixels: the one place where any of them is decoded, and none of absurd size is.

A PNG, JPEG or GIF of some kB may state a size whose pixels are gigabytes. So the size is asked for first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.image_size import stated_size

MAX_PIXELS = 1 << 27
"""More than any camera of a robot has."""


def decode_colour(data: bytes) -> NDArray[np.uint8] | None:
    """The pixels (H, W, 3), uint8, BGR, of a packed image as the sensor has it: EXIF turns nothing.

    None where it is no image, is damaged, or has more than `MAX_PIXELS`.
    """
    import cv2

    return _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def decode_depth(data: bytes) -> NDArray[Any] | None:
    """The pixels of a packed depth image in the file's own units and type: (H, W), or (H, W, C) where it has colours.

    None where it is no image, is damaged, or has more than `MAX_PIXELS`.
    """
    import cv2

    return _decode(data, cv2.IMREAD_UNCHANGED)


def _decode(data: bytes, flags: int) -> NDArray[Any] | None:
    import cv2

    try:
        size = stated_size(data)
    except ValueError:
        return None
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)
