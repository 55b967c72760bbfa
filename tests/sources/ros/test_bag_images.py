"""Images out of bags: every encoding against what was put in, depth in millimetres, nothing written that is no image."""

import struct

import cv2
import numpy as np
import pytest
from bag_writer import write_bag
from drive_bag import simulated

from objslam.core.diagnostics import Ledger
from objslam.ros.bag.recording import find_recording
from objslam.ros.messages.images import DEPTH_SCALE
from objslam.sources.ros_bag.log import extract_images, read_bag
from objslam.sources.ros_bag.options import BagOptions

_S = 10**9


def _extract(maker, folder, messages, depth=False, kind="mcap-zstd"):
    folder.mkdir(exist_ok=True)
    path = write_bag(folder / "bag", kind, maker, [("/image", t * _S, m) for t, m in enumerate(messages, start=1)])
    ledger = Ledger()
    found = extract_images(find_recording(path, ledger), {"/image": (folder / "out", depth)}, ledger)
    images = found.get("/image")
    pixels = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in images.paths] if images else []
    return images, pixels, ledger


@pytest.fixture
def colour():
    """A picture in OpenCV's order of colours; every channel differs."""
    return np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)


@pytest.mark.parametrize("vision", "14")
def test_plain_encodings(makers, tmp_path, colour, vision):
    maker = makers[vision]
    alpha = np.full((6, 8, 1), 200, np.uint8)
    wide = colour.astype(np.uint16) * 257
    cases = {
        "bgr8": (colour, colour),
        "rgb8": (colour[..., ::-1], colour),
        "bgra8": (np.concatenate([colour, alpha], axis=2), colour),
        "rgba8": (np.concatenate([colour[..., ::-1], alpha], axis=2), colour),
        "8UC3": (colour, colour),
        "mono8": (colour[..., 0], colour[..., 0]),
        "mono16": (wide[..., 0], wide[..., 0]),
        "bgr16": (wide, wide),
        "rgb16": (wide[..., ::-1], wide),
    }
    messages = [maker.image(t * _S + 5, image, name) for t, (name, (image, _)) in enumerate(cases.items(), start=1)]
    images, pixels, ledger = _extract(maker, tmp_path, messages, kind="bag" if maker.ros1 else "mcap-zstd")
    assert not ledger.lines()
    assert images.stamps.tolist() == [t + 5e-9 for t in range(1, len(cases) + 1)]
    assert images.paths[0].name == "1.000000005.png"
    for (name, (_, expected)), found in zip(cases.items(), pixels, strict=True):
        assert np.array_equal(found, expected), name
        assert found.dtype == expected.dtype


def test_rows_with_padding_and_big_endian(makers, tmp_path, colour):
    maker = makers["4"]
    padded = np.concatenate([colour.reshape(6, 24), np.full((6, 8), 77, np.uint8)], axis=1)
    deep = np.arange(48, dtype=np.uint16).reshape(6, 8) * 999
    messages = [
        maker.image(1, padded.reshape(6, 32)[:, :, None], "bgr8", step=32),
        maker.image(2, deep.astype(">u2"), "mono16", big_endian=True),
    ]
    messages[0].width = 8
    _, pixels, ledger = _extract(maker, tmp_path, messages)
    assert not ledger.lines()
    assert np.array_equal(pixels[0], colour)
    assert np.array_equal(pixels[1], deep)


def test_bayer_and_yuv_by_one_colour(makers, tmp_path):
    """A surface of one colour: each sensor pixel has the value of its filter, and every pixel comes out in that colour."""
    maker, blue, green, red = makers["4"], 30, 120, 210
    value = {"r": red, "g": green, "b": blue}
    messages = []
    for name in ("rggb", "bggr", "gbrg", "grbg"):
        cell = np.array([value[c] for c in name], dtype=np.uint8).reshape(2, 2)
        messages.append(maker.image(len(messages) + 1, np.tile(cell, (6, 6)), f"bayer_{name}8"))
    grey = np.full((4, 8, 2), 128, dtype=np.uint8)  # U = V = 128: no colour
    messages += [maker.image(5, grey, "yuv422"), maker.image(6, grey, "yuv422_yuy2")]
    _, pixels, ledger = _extract(maker, tmp_path, messages)
    assert not ledger.lines()
    for found in pixels[:4]:
        assert np.abs(found[2:-2, 2:-2].astype(int) - [blue, green, red]).max() <= 1
    for found in pixels[4:]:
        assert np.ptp(found) <= 1
        assert abs(int(found[0, 0, 0]) - 128) < 6


def test_compressed_images_keep_their_bytes(makers, tmp_path, colour):
    maker = makers["4"]
    jpeg, png = (cv2.imencode(ending, colour)[1].tobytes() for ending in (".jpg", ".png"))
    tiff = cv2.imencode(".tiff", colour)[1].tobytes()
    messages = [maker.compressed(1, jpeg, "bgr8; jpeg compressed bgr8"), maker.compressed(2, png, "png")]
    messages.append(maker.compressed(3, tiff, "tiff"))
    images, pixels, _ = _extract(maker, tmp_path, messages)
    assert [path.suffix for path in images.paths] == [".jpg", ".png", ".png"]
    assert images.paths[0].read_bytes() == jpeg
    assert images.paths[1].read_bytes() == png
    assert np.array_equal(pixels[2], colour)


def test_depth_is_in_millimetres_whatever_it_came_as(makers, tmp_path):
    maker = makers["4"]
    metres = np.array([[0.5, 1.0, 2.5, np.nan], [np.inf, -1.0, 70.0, 0.0]], dtype=np.float32)
    expected = np.array([[500, 1000, 2500, 0], [0, 0, 0, 0]], dtype=np.uint16)
    a, b = 100.0, -9.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(np.isfinite(metres) & (metres > 0) & (metres < 60), a / metres + b, 0).astype(np.uint16)
    png = cv2.imencode(".png", inverse)[1].tobytes()
    millimetres = cv2.imencode(".png", expected)[1].tobytes()
    header = struct.pack("<iff", 0, a, b)
    messages = [
        maker.image(1, expected, "16UC1"),
        maker.image(2, metres, "32FC1"),
        maker.compressed(3, header + millimetres, "16UC1; compressedDepth png"),
        maker.compressed(4, header + png, "32FC1; compressedDepth"),
    ]
    _, pixels, ledger = _extract(maker, tmp_path, messages, depth=True)
    assert not ledger.lines()
    assert DEPTH_SCALE == 1000
    for found in pixels[:3]:
        assert np.array_equal(found, expected)
    valid = expected > 0
    np.testing.assert_allclose(pixels[3][valid], expected[valid], rtol=0.02)
    assert not pixels[3][~valid].any()


def test_what_is_no_image_is_dropped_and_counted(makers, tmp_path, colour):
    maker = makers["4"]
    good = maker.image(9, colour, "bgr8")
    small, huge, unknown, narrow = (maker.image(t, colour, "bgr8") for t in (1, 2, 3, 4))
    small.data = small.data[:-1]
    huge.height = huge.width = 2**31
    unknown.encoding = "../../etc"
    narrow.step = 3
    wrong = [
        maker.compressed(5, b"\x89PNG\r\n no", "png"),
        maker.compressed(6, b"", "jpeg"),
        maker.compressed(7, b"nothing", "x"),
    ]
    images, pixels, ledger = _extract(maker, tmp_path, [good, small, huge, unknown, narrow])
    assert len(pixels) == 1
    assert sum(ledger.dropped.values()) == 4
    assert all(reason.startswith("image that cannot be decoded") for reason in ledger.dropped)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [images.paths[0].name]
    _, pixels, ledger = _extract(maker, tmp_path / "compressed", wrong)
    assert len(pixels) <= 1  # PNG and JPEG are taken by their first bytes, and looked into by who uses them
    assert sum(ledger.dropped.values()) >= 2


def test_stamps_that_repeat_or_go_back(makers, tmp_path, colour):
    maker = makers["4"]
    messages = [
        maker.image(t * _S, np.full((2, 2), value, np.uint8), "mono8") for t, value in ((5, 1), (5, 2), (3, 3), (6, 4))
    ]
    images, pixels, ledger = _extract(maker, tmp_path, messages)
    assert images.stamps.tolist() == [5, 6]
    assert [int(p[0, 0]) for p in pixels] == [1, 4]
    assert ledger.dropped == {"image with a stamp that repeats": 1, "image with a stamp that goes back": 1}


def test_boxes_get_their_depth_from_depth_images(makers, tmp_path):
    log = simulated()
    maker = makers["4"]
    from drive_bag import nanoseconds, rows_of

    rows = rows_of(log, maker)
    camera, stamps = log.cameras[0].camera, nanoseconds(log.cameras[0].detections.frame_stamps)
    for stamp in stamps[:3]:
        image = np.full((camera.height, camera.width), 1.25, dtype=np.float32)
        rows.append((f"/{camera.name}/depth", stamp, maker.image(stamp, image, "32FC1", f"{camera.name}_optical_frame")))
    path = write_bag(tmp_path / "bag", "mcap-zstd", maker, rows)
    (camera_log,) = read_bag(path, Ledger(), BagOptions(extract=tmp_path / "out")).cameras
    detections = camera_log.detections
    assert (detections.depths[detections.frame < 3] == 1.25).all()
    assert np.isnan(detections.depths[detections.frame >= 3]).all()
    (camera_log,) = read_bag(path, Ledger(), BagOptions(with_range=False)).cameras
    assert np.isnan(camera_log.detections.depths).all()
    assert camera_log.depth.paths[0].is_file()
