"""Read the size of an image from the header of its file, without decoding the image."""

import re
import struct
from collections.abc import Callable

_STANDALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # The JPEG markers without a segment.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # The JPEG markers of frame headers, which contain the size.
_WIDTH_TAG, _HEIGHT_TAG = 256, 257
_HEADER = 4096  # The most bytes of a Netpbm header that are read. Only comments can make such a header long.
_NUMBERS = re.compile(rb"P[1-6Ff](?:\s+|#[^\n]*\n)+([0-9]{1,9})(?:\s+|#[^\n]*\n)+([0-9]{1,9})\s")
_TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}  # `struct` formats by TIFF field type.


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height, px, from the header of an image file, or None for an unknown format.

    data: the content of the file. Raises ValueError if the header is damaged, or if a PNG file is cut off.
    """
    for magic, read in _READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, IndexError, ValueError, OverflowError) as error:  # BigTIFF offsets have 64 bits.
                raise ValueError("the header of an image is damaged or cut off") from error
    return None


def _pair(form: str, data: bytes, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(form, data, at)
    return first, second


def _png(data: bytes) -> tuple[int, int]:
    """Return the size of a PNG. Raises ValueError if a chunk states a length beyond the end of the file.

    OpenCV would take the memory for this length before it finds that the file is shorter.
    """
    size, at, kind = _pair(">II", data, 16), 8, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if at > len(data):
            raise ValueError("a chunk is longer than the rest of the file")
    return size


def _netpbm(data: bytes) -> tuple[int, int]:
    found = _NUMBERS.match(data[:_HEADER])
    if found is None:
        raise ValueError("no width and height")
    return int(found[1]), int(found[2])


def _pam(data: bytes) -> tuple[int, int]:
    words = data[: data.index(b"ENDHDR", 0, _HEADER)].split()
    width, height = (int(words[words.index(key) + 1]) for key in (b"WIDTH", b"HEIGHT"))
    return width, height


def _jpeg(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        at = data.index(0xFF, at) + 1  # Decoders also skip bytes between two segments.
        marker = data[at]
        if marker in _FRAMES:
            return _pair(">HH", data, at + 4)[::-1]
        if marker not in (0x00, 0xFF):
            at += 1
            if marker not in _STANDALONE:
                at += struct.unpack_from(">H", data, at)[0]


def _tiff(data: bytes) -> tuple[int, int]:
    order = "<" if data.startswith(b"II") else ">"
    if struct.unpack_from(order + "H", data, 2)[0] == 43:  # BigTIFF
        at = struct.unpack_from(order + "Q", data, 8)[0]
        number, first, step, value = struct.unpack_from(order + "Q", data, at)[0], at + 8, 20, 12
    else:
        at = struct.unpack_from(order + "I", data, 4)[0]
        number, first, step, value = struct.unpack_from(order + "H", data, at)[0], at + 2, 12, 8
    size = {_WIDTH_TAG: 0, _HEIGHT_TAG: 0}
    for entry in range(first, first + step * min(number, 1 << 16), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in size and kind in _TIFF_INTEGERS:
            stated = struct.unpack_from(order + _TIFF_INTEGERS[kind], data, entry + value)[0]
            size[tag] = max(size[tag], abs(stated))
    return size[_WIDTH_TAG], size[_HEIGHT_TAG]


def _webp(data: bytes) -> tuple[int, int]:
    kind = data[8:16]
    if kind == b"WEBPVP8 ":
        width, height = _pair("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"WEBPVP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"WEBPVP8X":
        bits = struct.unpack_from("<Q", data, 22)[0] >> 16
        return (bits & 0xFFFFFF) + 1, (bits >> 24) + 1
    raise ValueError("not a WebP image")


def _bmp(data: bytes) -> tuple[int, int]:
    old = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = _pair("<HH" if old else "<ii", data, 18)
    return abs(width), abs(height)


_READERS: dict[bytes, Callable[[bytes], tuple[int, int]]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8\xff": _jpeg,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
    b"RIFF": _webp,
    b"GIF8": lambda data: _pair("<HH", data, 6),
    b"BM": _bmp,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"PF", b"Pf"), _netpbm),
    b"P7": _pam,
}
