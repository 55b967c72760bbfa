"""Decode compressed images (PNG, JPEG, TIFF, ...) to pixels, except images with more than `MAX_PIXELS` pixels.

A PNG, JPEG or GIF file of some kB can state a size of gigabytes. The stated size is therefore checked first.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.image_size import stated_size

MAX_PIXELS = 1 << 27  # The limit of pixels per image, more than any robot camera has. The limit bounds memory.


def decode_colour(data: bytes) -> NDArray[np.uint8] | None:
    """Return the pixels (H, W, 3), uint8, BGR, of an image file, None if it cannot be decoded. EXIF rotation is ignored."""
    import cv2

    return _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def decode_depth(data: bytes) -> NDArray[Any] | None:
    """Return the pixels (H, W) or (H, W, C) of a depth image in its own units and type, None if it cannot be decoded."""
    import cv2

    return _decode(data, cv2.IMREAD_UNCHANGED)


def _decode(data: bytes, flags: int) -> NDArray[Any] | None:
    import cv2

    try:
        width, height = stated_size(data) or (0, 0)
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if width * height <= MAX_PIXELS else None
    except (ValueError, cv2.error):
        return None
    return None if image is None else np.asarray(image)
