"""Packed images: pixels come back, bombs do not go off."""

import ast
import struct
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import cv2
import image_bombs
import numpy as np
import pytest
from image_bombs import SIDE

import objslam
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.frontend.box_depths import read_depth
from objslam.io.image_size import stated_size
from objslam.io.images import MAX_PIXELS, decode_colour, decode_depth
from objslam.ros.messages.decode import DecodeError
from objslam.ros.messages.images import colour_image, depth_image


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff", ".webp", ".bmp", ".ppm", ".pam"])
def test_pixels_come_back(ending):
    image = np.full((20, 30, 3), 77, np.uint8)
    data = cv2.imencode(ending, image)[1].tobytes()
    np.testing.assert_allclose(decode_colour(data), image, atol=2)


def test_every_kind_of_colours_becomes_bgr_of_8_bits():
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    for ending, shown in (("png", image), ("bmp", image), ("webp", None), ("jpg", None)):
        data = cv2.imencode(f".{ending}", image)[1].tobytes()
        decoded = decode_colour(data)
        assert decoded.shape == (20, 30, 3)
        assert shown is None or np.array_equal(decoded, shown)
        assert decode_colour(data[: len(data) // 2]) is None
    grey = decode_colour(cv2.imencode(".png", image[:, :, 0])[1].tobytes())
    assert np.array_equal(grey, np.repeat(image[:, :, :1], 3, axis=2))
    deep = decode_colour(cv2.imencode(".png", image.astype(np.uint16) * 257)[1].tobytes())
    assert np.array_equal(deep, image)
    clear = decode_colour(cv2.imencode(".png", np.dstack([image, image[:, :, 0]]))[1].tobytes())
    assert np.array_equal(clear, image)


def test_a_colour_image_stays_as_the_sensor_has_it():
    """EXIF says "turned by 90 degrees": the camera model is that of the sensor."""
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (30, 20, 3)
    assert np.array_equal(decode_colour(turned), decode_colour(jpeg))
    message = SimpleNamespace(format="jpeg", data=np.frombuffer(turned, np.uint8))
    assert np.array_equal(colour_image(message), decode_colour(jpeg))


@pytest.mark.parametrize("ending", [".png", ".tiff", ".pgm"])
def test_depth_keeps_its_bits(ending):
    depth = np.arange(600, dtype=np.uint16).reshape(20, 30) * 100
    np.testing.assert_array_equal(decode_depth(cv2.imencode(ending, depth)[1].tobytes()), depth)


@pytest.mark.parametrize(
    "data",
    [b"", b"x", b"\x89PNG\r\n\x1a\n", image_bombs.png(5, 5)[:30], b"\xff\xd8\xff", b"BM", b"RIFF"]
    + [struct.pack("<4sHHQ", b"II+\0", 8, 0, offset) for offset in (2**63 - 9, 2**63, 2**64 - 1)],
)
def test_what_is_no_image(data):
    assert decode_colour(data) is None
    assert decode_depth(data) is None


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff", ".webp", ".gif", ".bmp", ".ppm", ".pam"])
def test_the_size_is_read_off_the_header(ending):
    data = cv2.imencode(ending, np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8))[1].tobytes()
    assert stated_size(data) == (30, 20)
    for length in range(len(data)):
        with suppress(ValueError):
            assert stated_size(data[:length]) in (None, (30, 20))
    with pytest.raises(ValueError, match="damaged or cut off"):
        stated_size(data[:8])


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_size_of_a_large_tiff(order):
    """BigTIFF, whose fields have 8 bytes."""
    magic = b"II+\0" if order == "<" else b"MM\0+"
    fields = [struct.pack(order + "HHQQ", tag, 16, 1, value) for tag, value in ((256, 70_000), (257, 80_000))]
    data = magic + struct.pack(order + "HHQQ", 8, 0, 16, len(fields)) + b"".join(fields)
    assert stated_size(data) == (70_000, 80_000)
    assert decode_colour(data) is None


@pytest.mark.parametrize(
    "bomb",
    [
        lambda: image_bombs.png(SIDE, SIDE),
        lambda: image_bombs.png(40_000, 40_000, rows=2000),
        lambda: image_bombs.jpeg(SIDE, SIDE),
        lambda: image_bombs.gif(SIDE, SIDE),
        lambda: image_bombs.png(5, 5).replace(struct.pack(">I", 13) + b"IHDR", struct.pack(">I", 1 << 30) + b"IHDR"),
        lambda: b"P6\n# by hand\n%d %d\n255\n" % (SIDE, SIDE) + bytes(100),
        lambda: b"PF %d %d -1\n" % (SIDE, SIDE) + bytes(100),
        lambda: b"P7\nWIDTH %d\nHEIGHT %d\nDEPTH 3\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n" % (SIDE, SIDE) + bytes(100),
        lambda: b"Y\xa6j\x95" + struct.pack(">7I", SIDE, SIDE, 24, 3 * SIDE * SIDE, 1, 0, 0),
        lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (SIDE, SIDE) + bytes(100),
    ],
    ids=["png", "png cut off", "jpeg", "gif", "png chunk", "ppm", "pfm", "pam", "sun", "hdr"],
)
def test_a_small_file_of_absurd_size_is_not_unpacked(bomb, monkeypatch):
    data = bomb()
    assert len(data) < 1_000_000
    assert SIDE**2 > MAX_PIXELS
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it is unpacked"))
    assert decode_colour(data) is None
    assert decode_depth(data) is None
    message = SimpleNamespace(format="png", data=np.frombuffer(data, np.uint8))
    with pytest.raises(DecodeError):
        colour_image(message)
    with pytest.raises(DecodeError):
        depth_image(message)


def test_a_depth_image_of_absurd_size_is_counted(tmp_path):
    bomb = image_bombs.png(SIDE, SIDE, bits=16)
    (tmp_path / "depth.png").write_bytes(bomb)
    ledger = Ledger()
    assert read_depth(tmp_path / "depth.png", Camera("front", SIDE, SIDE, np.eye(3)), ledger) is None
    assert ledger.dropped == {"depth image that cannot be decoded": 1}
    packed = SimpleNamespace(format="16UC1; compressedDepth png", data=np.frombuffer(bytes(12) + bomb, np.uint8))
    with pytest.raises(DecodeError, match="not PNG of 16 bits"):
        depth_image(packed)


def test_images_are_decoded_in_one_place():
    package = Path(objslam.__file__).parent
    decoding = {"imdecode", "imread", "imdecodemulti", "imreadmulti"}
    found = {
        str(module.relative_to(package))
        for module in package.rglob("*.py")
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr in decoding
    }
    assert found == {"io/images.py"}


def test_a_jpeg_with_hundreds_of_scans_is_refused():
    whole = cv2.imencode(".jpg", np.zeros((2048, 2048, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = whole.rindex(b"\xff\xda")
    assert decode_colour(whole) is not None
    assert decode_colour(whole[:last] + 200 * whole[last:-2] + b"\xff\xd9") is None
