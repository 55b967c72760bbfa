"""Decode image files (PNG, JPEG, TIFF, ...) to pixels, except images that would take much memory or time.

A file of a few bytes can state a size of gigabytes. A JPEG file can have thousands of scans, and each scan can change all
pixels. The stated size and the number of scans are therefore checked before the image is decoded. An image is not decoded
if `stated_size` does not know its format.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.image_size import stated_size

MAX_PIXELS = 1 << 26
"""The largest number of pixels of an image that is decoded. A larger number takes more memory and time. A PNG with this
number of pixels takes 3 s. No robot's camera has more pixels."""
_MAX_SCANNED = 1 << 29
"""The largest product of the number of pixels and the number of scans of a JPEG that is decoded. A larger product takes more
time. An image of 16 million pixels in 100 scans has three times this product, and took 4 s. A progressive JPEG has about ten
scans."""
_JPEG, _SCAN = b"\xff\xd8\xff", b"\xff\xda"  # The first bytes of a JPEG, and the marker before each scan.


def decode_colour(data: bytes) -> NDArray[np.uint8] | None:
    """Return the pixels (H, W, 3), uint8, BGR, of an image file. Return None if the image is not decoded.

    data: the content of the file. The rotation in the EXIF data is ignored.
    """
    import cv2

    return _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def decode_depth(data: bytes) -> NDArray[Any] | None:
    """Return the pixels (H, W) or (H, W, C) of a depth image file, in the units and the type of the file.

    data: the content of the file. Return None if the image is not decoded.
    """
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
