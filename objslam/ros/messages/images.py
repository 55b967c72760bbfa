"""Image messages as pixels, and as the content of files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.images import decode_colour, decode_depth
from objslam.ros.messages.decode import DecodeError

DEPTH_SCALE = 1000.0  # The units of a metre in depth images that are decoded or written.
_MAX_SIDE = 1 << 15  # The longest side of an image, px; above it a message is taken for damaged.
_PLAIN = {"mono8": (np.uint8, 1), "8uc1": (np.uint8, 1), "mono16": (np.uint16, 1), "16uc1": (np.uint16, 1),
          "32fc1": (np.float32, 1), "bgr8": (np.uint8, 3), "8uc3": (np.uint8, 3), "rgb8": (np.uint8, 3),
          "bgra8": (np.uint8, 4), "8uc4": (np.uint8, 4), "rgba8": (np.uint8, 4), "bgr16": (np.uint16, 3),
          "rgb16": (np.uint16, 3), "yuv422": (np.uint8, 2), "uyvy": (np.uint8, 2), "yuv422_yuy2": (np.uint8, 2),
          "yuyv": (np.uint8, 2)}  # fmt: skip
_CONVERSIONS = {"rgb8": "COLOR_RGB2BGR", "rgba8": "COLOR_RGBA2BGR", "bgra8": "COLOR_BGRA2BGR", "8uc4": "COLOR_BGRA2BGR",
                "rgb16": "COLOR_RGB2BGR", "yuv422": "COLOR_YUV2BGR_UYVY", "uyvy": "COLOR_YUV2BGR_UYVY",
                "yuv422_yuy2": "COLOR_YUV2BGR_YUY2", "yuyv": "COLOR_YUV2BGR_YUY2",
                # OpenCV names a Bayer pattern after the second row's second and third pixel
                "bayer_rggb": "COLOR_BayerBG2BGR", "bayer_bggr": "COLOR_BayerRG2BGR",
                "bayer_gbrg": "COLOR_BayerGR2BGR", "bayer_grbg": "COLOR_BayerGB2BGR"}  # fmt: skip
_ENDINGS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n": ".png"}
_DEPTH_HEADER = 12  # The bytes before the PNG in a message of compressed depth.


def colour_image(message: Any) -> NDArray[Any]:
    """A sensor_msgs/Image or CompressedImage as pixels (H, W, 3), uint8, BGR; DecodeError where it is none, or depth."""
    if (packing := _packing(message)) is not None:
        image = decode_colour(bytes(message.data))
        if image is None or "compresseddepth" in packing:
            raise DecodeError(f"not a colour image of the format {message.format[:40]!r}")
        return image
    image = _colours(message)
    if image.dtype == np.uint16:
        image = (image // 256).astype(np.uint8)
    return _convert(image, "COLOR_GRAY2BGR") if image.ndim == 2 else image


def depth_image(message: Any) -> NDArray[Any]:
    """A sensor_msgs/Image or CompressedImage of depth as (H, W), uint16, in `DEPTH_SCALE` units per metre, 0 where unknown.

    DecodeError where it is none.
    """
    if (packing := _packing(message)) is None:
        return _depth_units(_pixels(message)[0])
    data = bytes(message.data)
    if "compresseddepth" in packing:
        return _compressed_depth(data, packing)
    image = decode_depth(data)
    if image is None:
        raise DecodeError(f"not an image of the format {message.format[:40]!r}")
    return _depth_units(image)


def image_file(message: Any, depth: bool) -> tuple[bytes, str]:
    """A sensor_msgs/Image or CompressedImage as the content of a file, and the ending of its name.

    JPEG and PNG stay as they are, all else becomes PNG; depth as `depth_image` has it. DecodeError where it is none.
    """
    packing = _packing(message)
    if depth or "compresseddepth" in (packing or ""):
        return _encode(depth_image(message)), ".png"
    if packing is None:
        return _encode(_colours(message)), ".png"
    data = message.data.tobytes()
    ending = next((ending for magic, ending in _ENDINGS.items() if data.startswith(magic)), None)
    if ending is not None:
        return data, ending
    image = decode_colour(data)
    if image is None:
        raise DecodeError(f"not an image of the format {message.format[:40]!r}")
    return _encode(image), ".png"


def _packing(message: Any) -> str | None:
    """The format of a CompressedImage, without capitals and blanks; None for an Image."""
    return str(message.format).lower().replace(" ", "") if hasattr(message, "format") else None


def _colours(message: Any) -> NDArray[Any]:
    """The pixels of a sensor_msgs/Image in grey or BGR, of 8 or 16 bits."""
    image, conversion = _pixels(message)
    if image.dtype == np.float32:
        raise DecodeError("it is of floats, which no colour image is")
    return image if conversion is None else _convert(image, conversion)


def _pixels(message: Any) -> tuple[NDArray[Any], str | None]:
    """The pixels of a sensor_msgs/Image, (H, W) or (H, W, C), and how their colours become BGR, as OpenCV calls it."""
    encoding, height, width = message.encoding.lower(), int(message.height), int(message.width)
    bayer = encoding.startswith("bayer_") and encoding.endswith("8")
    if encoding not in _PLAIN and not bayer:
        raise DecodeError(f"its encoding {message.encoding[:40]!r} is not known")
    dtype, channels = (np.uint8, 1) if bayer else _PLAIN[encoding]
    row = width * channels * np.dtype(dtype).itemsize
    step = int(message.step) or row
    if not (
        0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE and step >= row and len(message.data) >= step * (height - 1) + row
    ):
        raise DecodeError(f"it says {width} x {height} pixels and has {len(message.data)} bytes")
    rows = np.lib.stride_tricks.as_strided(np.asarray(message.data, dtype=np.uint8), (height, row), (step, 1))
    image: NDArray[Any] = np.ascontiguousarray(rows).view(np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<"))
    image = image.astype(dtype).reshape(height, width, channels) if channels > 1 else image.astype(dtype)
    return image, _CONVERSIONS.get(encoding.removesuffix("8") if bayer else encoding)


def _convert(image: NDArray[Any], conversion: str) -> NDArray[Any]:
    import cv2

    try:
        return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)))
    except cv2.error as error:
        raise DecodeError("its colours cannot be converted") from error


def _compressed_depth(data: bytes, packing: str) -> NDArray[Any]:
    """compressed_depth_image_transport: a PNG behind a header, of floats as quantised inverse depth (a / depth + b)."""
    if b"\x89PNG" != data[_DEPTH_HEADER : _DEPTH_HEADER + 4]:
        raise DecodeError("its compressed depth is not PNG")
    image = decode_depth(data[_DEPTH_HEADER:])
    if image is None or image.dtype != np.uint16:
        raise DecodeError("its compressed depth is not PNG of 16 bits")
    if packing.startswith("32fc1"):
        a, b = np.frombuffer(data, dtype="<f4", count=2, offset=4)
        with np.errstate(divide="ignore", invalid="ignore"):
            image = np.where(image > 0, a / (image - b), np.nan).astype(np.float32)
    return _depth_units(image)


def _depth_units(image: NDArray[Any]) -> NDArray[Any]:
    """Depth in units of `DEPTH_SCALE`: 16 bit images are in millimetres (REP 118), floats in metres."""
    if image.dtype == np.uint16 and image.ndim == 2:
        return image
    if image.dtype != np.float32 or image.ndim != 2:
        raise DecodeError("depth of a kind that is not known")
    units = np.round(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64) * DEPTH_SCALE)
    return np.where((units > 0) & (units < 1 << 16), units, 0).astype(np.uint16)


def _encode(image: NDArray[Any]) -> bytes:
    """The image as PNG."""
    import cv2

    try:
        done, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    except cv2.error as error:
        raise DecodeError("it cannot be written as PNG") from error
    if not done:
        raise DecodeError("it cannot be written as PNG")
    return bytes(content)
