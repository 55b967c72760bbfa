"""Packed images (PNG, JPEG, ...) as pixels, but none of absurd size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 1 << 27
"""More than any camera of a robot has."""

_PNG = b"\x89PNG\r\n\x1a\n"


def decode_image(data: bytes, *, colour: bool = False) -> NDArray[Any] | None:
    """The pixels of a packed image: as they are, or (colour) as BGR of 8 bits; None where it is no image, or of absurd size.

    A PNG of some kB may unpack to gigabytes; its header, which tells, is looked at first.
    """
    import cv2

    if data.startswith(_PNG) and int.from_bytes(data[16:20], "big") * int.from_bytes(data[20:24], "big") > MAX_PIXELS:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)
