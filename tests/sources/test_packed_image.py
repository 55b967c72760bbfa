"""Packed images: pixels come back, bombs do not go off."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from objslam.sources.packed_image import MAX_PIXELS, decode_image


def png(width, height):
    """A grey PNG of zeros: rows compress a thousandfold."""

    def part(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = zlib.compress(bytes((width + 1) * min(height, 2000)))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", rows) + part(b"IEND", b"")


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff"])
def test_pixels_come_back(ending):
    image = np.full((20, 30, 3), 77, np.uint8)
    data = cv2.imencode(ending, image)[1].tobytes()
    np.testing.assert_allclose(decode_image(data), image, atol=2)
    grey = cv2.imencode(ending, image[..., 0])[1].tobytes()
    assert decode_image(grey).ndim == 2
    assert decode_image(grey, colour=True).shape == (20, 30, 3)


def test_depth_keeps_its_bits():
    depth = np.arange(600, dtype=np.uint16).reshape(20, 30) * 100
    np.testing.assert_array_equal(decode_image(cv2.imencode(".png", depth)[1].tobytes()), depth)


@pytest.mark.parametrize("data", [b"", b"x", b"\x89PNG\r\n\x1a\n", png(5, 5)[:30], b"\xff\xd8\xff"])
def test_what_is_no_image(data):
    assert decode_image(data) is None


def test_a_small_file_of_absurd_size_is_not_unpacked():
    assert decode_image(png(300, 200)).shape == (200, 300)
    data = png(40_000, 40_000)
    assert len(data) < 200_000
    assert 40_000 * 40_000 > MAX_PIXELS
    assert decode_image(data) is None
