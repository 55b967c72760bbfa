"""Decode image files (PNG, JPEG, TIFF, ...) to pixels, except images that would take much memory or time.

A file of some bytes can state a size of gigabytes. A JPEG file can have thousands of scans, each of which changes all
pixels. The stated size and the number of scans are therefore checked before the image is decoded. A format whose header
`stated_size` cannot read is not decoded.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.image_size import stated_size

MAX_PIXELS = 1 << 26
"""The most pixels of an image. A PNG with this number takes 3 s. A larger number takes more memory and time. No robot's
camera has more."""
_MAX_SCANNED = 1 << 29
"""The largest product of the pixels and the scans of a JPEG. A larger number takes more time: 16 million pixels in 100 scans
are three times this number, and took 4 s. A progressive JPEG has about ten scans."""
_JPEG, _SCAN = b"\xff\xd8\xff", b"\xff\xda"  # The first bytes of a JPEG, and the marker before each scan.


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
        size = stated_size(data)
        if size is None:
            return None
        width, height = size
        scans = data.count(_SCAN) if data.startswith(_JPEG) else 1
        if width * height > MAX_PIXELS or width * height * scans > _MAX_SCANNED:
            return None
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except (ValueError, cv2.error):
        return None
    return None if image is None else np.asarray(image)
