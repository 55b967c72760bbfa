"""Small image files that state an enormous size."""

import struct
import zlib

import cv2
import numpy as np

SIDE = 12_000
"""px; the square of it is more than any camera has, and little enough that a test may fail by unpacking it."""


def png(width: int, height: int, bits: int = 8, rows: int | None = None) -> bytes:
    """A grey PNG of zeros, which compress a thousandfold. rows: how many of them it brings, all if None."""

    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    row = bytes(1 + width * bits // 8)
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(row) for _ in range(height if rows is None else rows)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", packed) + part(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """A JPEG whose data end after a few rows: decoders fill in the rest."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def gif(width: int, height: int) -> bytes:
    """A GIF with a small picture on a large screen."""
    data = bytearray(cv2.imencode(".gif", np.zeros((64, 64, 3), np.uint8))[1].tobytes())
    data[6:10] = struct.pack("<HH", width, height)
    return bytes(data)
