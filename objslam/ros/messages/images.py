"""Convert image messages to pixel arrays and to file contents."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.io.images import decode_colour, decode_depth
from objslam.ros.messages.decode import DecodeError

DEPTH_SCALE = 1000.0  # The number of depth units per metre in decoded and written depth images.
_MAX_SIDE = 1 << 15  # The limit of width and height, px. A message with a larger image counts as damaged.
_PLAIN = {"mono8": (np.uint8, 1), "8uc1": (np.uint8, 1), "mono16": (np.uint16, 1), "16uc1": (np.uint16, 1),
          "32fc1": (np.float32, 1), "bgr8": (np.uint8, 3), "8uc3": (np.uint8, 3), "rgb8": (np.uint8, 3),
          "bgra8": (np.uint8, 4), "8uc4": (np.uint8, 4), "rgba8": (np.uint8, 4), "bgr16": (np.uint16, 3),
          "rgb16": (np.uint16, 3), "yuv422": (np.uint8, 2), "uyvy": (np.uint8, 2), "yuv422_yuy2": (np.uint8, 2),
          "yuyv": (np.uint8, 2)}  # fmt: skip
_CONVERSIONS = {"rgb8": "COLOR_RGB2BGR", "rgba8": "COLOR_RGBA2BGR", "bgra8": "COLOR_BGRA2BGR", "8uc4": "COLOR_BGRA2BGR",
                "rgb16": "COLOR_RGB2BGR", "yuv422": "COLOR_YUV2BGR_UYVY", "uyvy": "COLOR_YUV2BGR_UYVY",
                "yuv422_yuy2": "COLOR_YUV2BGR_YUY2", "yuyv": "COLOR_YUV2BGR_YUY2",
                # OpenCV names a Bayer pattern by the second and third pixel of the second row.
                "bayer_rggb": "COLOR_BayerBG2BGR", "bayer_bggr": "COLOR_BayerRG2BGR",
                "bayer_gbrg": "COLOR_BayerGR2BGR", "bayer_grbg": "COLOR_BayerGB2BGR"}  # fmt: skip
_ENDINGS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n": ".png"}
_DEPTH_HEADER = 12  # The size of the header before the PNG in a compressed depth message, bytes.


def colour_image(message: Any) -> NDArray[Any]:
    """Return the pixels (H, W, 3), uint8, BGR, of an image message.

    Raises DecodeError if the data are malformed, or if they are float depth or compressed depth.
    """
    if (packing := _packing(message)) is not None:
        if "compresseddepth" in packing:
            raise DecodeError(f"not a colour image but depth of the format {message.format[:40]!r}")
        return _unpack(decode_colour, message)
    image = _colours(message)
    if image.dtype == np.uint16:
        image = (image // 256).astype(np.uint8)
    return _convert(image, "COLOR_GRAY2BGR") if image.ndim == 2 else image


def depth_image(message: Any) -> NDArray[Any]:
    """Return the depth (H, W) in an image message as uint16, in units of 1 / `DEPTH_SCALE` m. An unknown depth is 0. Raises
    DecodeError if the message is malformed or not a depth image."""
    if (packing := _packing(message)) is None:
        return _depth_units(_pixels(message)[0])
    if "compresseddepth" in packing:
        return _compressed_depth(bytes(message.data), packing)
    return _depth_units(_unpack(decode_depth, message))


def image_file(message: Any, depth: bool) -> tuple[bytes, str]:
    """Return the content and the suffix of a file for an image message. Raises DecodeError if the message is malformed.

    depth: whether the message is a depth image. A depth image becomes a PNG of the result of `depth_image`. A colour image
    in JPEG or PNG is not changed. Any other colour image becomes a PNG.
    """
    packing = _packing(message)
    if depth or "compresseddepth" in (packing or ""):
        return _encode(depth_image(message)), ".png"
    if packing is None:
        return _encode(_colours(message)), ".png"
    data = message.data.tobytes()
    ending = next((ending for magic, ending in _ENDINGS.items() if data.startswith(magic)), None)
    return (data, ending) if ending is not None else (_encode(_unpack(decode_colour, message)), ".png")


def _unpack(decode: Callable[[bytes], NDArray[Any] | None], message: Any) -> NDArray[Any]:
    image = decode(bytes(message.data))
    if image is None:
        raise DecodeError(f"not an image of the format {message.format[:40]!r}")
    return image


def _packing(message: Any) -> str | None:
    """Return the format of a CompressedImage in lower case without blanks. Return None for an Image."""
    return str(message.format).lower().replace(" ", "") if hasattr(message, "format") else None


def _colours(message: Any) -> NDArray[Any]:
    image, conversion = _pixels(message)
    if image.dtype == np.float32:
        raise DecodeError("its pixels are floats, which a colour image cannot have")
    return image if conversion is None else _convert(image, conversion)


def _pixels(message: Any) -> tuple[NDArray[Any], str | None]:
    """Return the pixels (H, W) or (H, W, C) of a sensor_msgs/Image, and the name of the OpenCV conversion to BGR. The name
    is None if no conversion is needed."""
    encoding, height, width = message.encoding.lower(), int(message.height), int(message.width)
    bayer = encoding.startswith("bayer_") and encoding.endswith("8")
    if encoding not in _PLAIN and not bayer:
        raise DecodeError(f"its encoding {message.encoding[:40]!r} is not known")
    dtype, channels = (np.uint8, 1) if bayer else _PLAIN[encoding]
    row = width * channels * np.dtype(dtype).itemsize
    step = int(message.step) or row
    sane = 0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE and step >= row
    if not sane or len(message.data) < step * (height - 1) + row:
        raise DecodeError(f"its {len(message.data)} bytes do not fit its size of {width} x {height} pixels")
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
    """Return the depth (H, W) in data of compressed_depth_image_transport, as `depth_image` does. The data are a header and
    a PNG.

    If the original image has floats, a pixel of the PNG is a / depth + b, with the depth in m. The header has a and b.
    """
    if b"\x89PNG" != data[_DEPTH_HEADER : _DEPTH_HEADER + 4]:
        raise DecodeError("its compressed depth is not PNG")
    image = decode_depth(data[_DEPTH_HEADER:])
    if image is None or image.dtype != np.uint16:
        raise DecodeError("its compressed depth is not PNG of 16 bits")
    if packing.startswith("32fc1"):
        a, b = np.frombuffer(data, dtype="<f4", count=2, offset=4)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            image = np.where(image > 0, a / (image - b), np.nan).astype(np.float32)
    return _depth_units(image)


def _depth_units(image: NDArray[Any]) -> NDArray[Any]:
    """Return the depth (H, W) as uint16, in units of 1 / `DEPTH_SCALE` m. An unknown depth is 0.

    image: (H, W) depth as in REP 118, which is uint16 in mm or float32 in m.
    """
    if image.dtype == np.uint16 and image.ndim == 2:
        return image
    if image.dtype != np.float32 or image.ndim != 2:
        raise DecodeError("its depth is neither 16-bit integers nor 32-bit floats")
    units = np.round(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64) * DEPTH_SCALE)
    return np.where((units > 0) & (units < 1 << 16), units, 0).astype(np.uint16)


def _encode(image: NDArray[Any]) -> bytes:
    import cv2

    with suppress(cv2.error):
        done, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if done:
            return bytes(content)
    raise DecodeError("it cannot be written as PNG")
