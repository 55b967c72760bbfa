"""Images out of a recording into files, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.errors import LogError
from objslam.ledger import Ledger
from objslam.sources.packed_image import decode_image
from objslam.sources.ros.decode import Undecodable, make_decoder, read_head
from objslam.sources.ros.recording import Recording, read_messages
from objslam.sources.ros.records import Connection, FileReport
from objslam.sources.ros.survey import COMPRESSED
from objslam.sources.textfile import count_drops, in_order
from objslam.types import Images

DEPTH_SCALE = 1000.0
"""Units per metre in the depth images that are written."""

_MAX_SIDE = 1 << 15
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
_DEPTH_HEADER = 12


def extract_images(recording: Recording, folders: Mapping[str, tuple[Path, bool]], ledger: Ledger) -> dict[str, Images]:
    """Write the images of topics into files, and list them by topic.

    folders: for each topic where to, and whether it is depth. JPEG and PNG are written as they are, all else as PNG; depth
    as 16 bit PNG in `DEPTH_SCALE` units per metre, 0 where unknown. Files are named after the stamp. Images that cannot be
    decoded, and stamps that repeat or go back, are dropped and counted. One image is in memory at a time. LogError where
    they cannot be written.
    """
    written: dict[str, dict[int, Path]] = {topic: {} for topic in folders}
    decoders: dict[int, tuple[Connection, Callable[[bytes], Any]]] = {}
    reports: list[FileReport] = []
    for folder, _ in folders.values():
        _make_folder(folder)
    for connection, logged, data in read_messages(recording, lambda connection: connection.topic in folders, reports):
        folder, depth = folders[connection.topic]
        place = f"{connection.topic} at {logged / 1e9:.3f} s"
        try:
            if id(connection) not in decoders:
                decoders[id(connection)] = connection, make_decoder(connection)
            stamp = read_head(data, connection.encoding)[0] or logged
            if stamp in written[connection.topic]:
                ledger.drop("image with a stamp that repeats", where=place)
                continue
            message = decoders[id(connection)][1](data)
            content, ending = (_compressed if connection.type == COMPRESSED else _raw)(message, depth)
        except Undecodable as error:
            ledger.drop(f"image that cannot be decoded ({error})", where=place)
            continue
        path = folder / f"{stamp // 10**9}.{stamp % 10**9:09d}{ending}"
        _write(path, content)
        written[connection.topic][stamp] = path
    found = {}
    for topic, paths in written.items():
        seconds = np.array(list(paths), dtype=np.int64) / 1e9
        forward = in_order(seconds)
        late = (f"{topic} at {stamp:.3f} s" for stamp in seconds[~forward].tolist())
        count_drops("image with a stamp that goes back", int((~forward).sum()), late, ledger)
        if forward.any():
            found[topic] = Images(seconds[forward], tuple(compress(paths.values(), forward)))
    return found


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"cannot be made for the images: {error.strerror or error}", where=str(folder)) from error


def _write(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        raise LogError(f"an image cannot be written: {error.strerror or error}", where=str(path)) from error


def colour_image(message: Any) -> NDArray[Any]:
    """A sensor_msgs/Image or CompressedImage as pixels (H, W, 3), uint8, BGR; Undecodable where it is none, or depth."""
    if hasattr(message, "format"):
        image = decode_image(bytes(message.data), colour=True)
        if image is None or "compresseddepth" in message.format.lower().replace(" ", ""):
            raise Undecodable(f"not a colour image of the format {message.format[:40]!r}")
        return image
    image, conversion = _pixels(message)
    if image.dtype == np.float32:
        raise Undecodable("it is of floats, which no colour image is")
    if conversion is not None:
        image = _convert(image, conversion)
    if image.dtype == np.uint16:
        image = (image // 256).astype(np.uint8)
    return _convert(image, "COLOR_GRAY2BGR") if image.ndim == 2 else image


def depth_image(message: Any) -> NDArray[Any]:
    """A sensor_msgs/Image or CompressedImage of depth as (H, W), uint16, in `DEPTH_SCALE` units per metre, 0 where unknown.

    Undecodable where it is none.
    """
    if not hasattr(message, "format"):
        return _depth_units(_pixels(message)[0])
    data, packing = bytes(message.data), message.format.lower().replace(" ", "")
    if "compresseddepth" in packing:
        return _compressed_depth(data, packing)
    image = decode_image(data)
    if image is None:
        raise Undecodable(f"not an image of the format {message.format[:40]!r}")
    return _depth_units(image)


def _raw(message: Any, depth: bool) -> tuple[bytes, str]:
    """A sensor_msgs/Image as the content of a PNG file."""
    if depth:
        return _encode(depth_image(message)), ".png"
    image, conversion = _pixels(message)
    if image.dtype == np.float32:
        raise Undecodable("it is of floats, which no colour image is")
    return _encode(image if conversion is None else _convert(image, conversion)), ".png"


def _pixels(message: Any) -> tuple[NDArray[Any], str | None]:
    """The pixels of a sensor_msgs/Image, (H, W) or (H, W, C), and how their colours become BGR, as OpenCV calls it."""
    encoding, height, width = message.encoding.lower(), int(message.height), int(message.width)
    bayer = encoding.startswith("bayer_") and encoding.endswith("8")
    if encoding not in _PLAIN and not bayer:
        raise Undecodable(f"its encoding {message.encoding[:40]!r} is not known")
    dtype, channels = (np.uint8, 1) if bayer else _PLAIN[encoding]
    row = width * channels * np.dtype(dtype).itemsize
    step = int(message.step) or row
    if not (
        0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE and step >= row and len(message.data) >= step * (height - 1) + row
    ):
        raise Undecodable(f"it says {width} x {height} pixels and has {len(message.data)} bytes")
    rows = np.lib.stride_tricks.as_strided(np.asarray(message.data, dtype=np.uint8), (height, row), (step, 1))
    image: NDArray[Any] = np.ascontiguousarray(rows).view(np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<"))
    image = image.astype(dtype).reshape(height, width, channels) if channels > 1 else image.astype(dtype)
    return image, _CONVERSIONS.get(encoding.removesuffix("8") if bayer else encoding)


def _convert(image: NDArray[Any], conversion: str) -> NDArray[Any]:
    import cv2

    try:
        return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)))
    except cv2.error as error:
        raise Undecodable("its colours cannot be converted") from error


def _compressed(message: Any, depth: bool) -> tuple[bytes, str]:
    """A sensor_msgs/CompressedImage as the content of a file, and the ending of its name."""
    data = message.data.tobytes()
    if depth or "compresseddepth" in message.format.lower().replace(" ", ""):
        return _encode(depth_image(message)), ".png"
    ending = next((ending for magic, ending in _ENDINGS.items() if data.startswith(magic)), None)
    if ending is not None:
        return data, ending
    image = decode_image(data)
    if image is None:
        raise Undecodable(f"not an image of the format {message.format[:40]!r}")
    return _encode(image), ".png"


def _compressed_depth(data: bytes, packing: str) -> NDArray[Any]:
    """compressed_depth_image_transport: a PNG behind a header, of floats as quantised inverse depth (a / depth + b)."""
    if b"\x89PNG" != data[_DEPTH_HEADER : _DEPTH_HEADER + 4]:
        raise Undecodable("its compressed depth is not PNG")
    image = decode_image(data[_DEPTH_HEADER:])
    if image is None or image.dtype != np.uint16:
        raise Undecodable("its compressed depth is not PNG of 16 bits")
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
        raise Undecodable("depth of a kind that is not known")
    units = np.round(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64) * DEPTH_SCALE)
    return np.where((units > 0) & (units < 1 << 16), units, 0).astype(np.uint16)


def _encode(image: NDArray[Any]) -> bytes:
    """The image as PNG."""
    import cv2

    try:
        done, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    except cv2.error as error:
        raise Undecodable("it cannot be written as PNG") from error
    if not done:
        raise Undecodable("it cannot be written as PNG")
    return bytes(content)
