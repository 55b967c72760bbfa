"""A drive written as a bag of every kind reads back as the same arrays, and gives the same map."""

import numpy as np
import pytest
from bag_writer import write_bag
from drive_bag import rows_of, simulated
from quick import HELD

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.io.camera_yaml import read_mounts, write_camera
from objslam.io.detections_jsonl import write_detections
from objslam.mapping import pipeline
from objslam.simulation import make_camera
from objslam.sources import SourceOptions, convert, read
from objslam.sources.log_folder import read_log_folder, write_log_folder

KINDS = ["1-bag", "1-bag-bz2", "1-bag-lz4", "1-mcap-zstd", "2-sqlite3", "2-sqlite3-old", "3-sqlite3-message", "3-mcap-none",
         "4-sqlite3", "4-sqlite3-old", "4-sqlite3-file", "4-mcap-none", "4-mcap-lz4", "4-mcap-zstd"]  # fmt: skip


@pytest.fixture(scope="module")
def log():
    return simulated()


def _close(a, b):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def _same_path(found, expected):
    _close(found.stamps, expected.stamps)
    _close(found.poses, expected.poses)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_arrays(tmp_path, makers, log, kind):
    vision, _, storage = kind.partition("-")
    maker = makers[vision]
    path = write_bag(tmp_path / "drive", storage, maker, rows_of(log, maker))
    ledger = Ledger()
    found = read(path, ledger)
    assert not ledger.lines()
    _same_path(found.odometry, log.odometry)
    _same_path(found.localization, log.localization)
    (camera_log,), (expected,) = found.cameras, log.cameras
    assert camera_log.camera.name == expected.camera.name
    assert (camera_log.camera.width, camera_log.camera.height) == (expected.camera.width, expected.camera.height)
    for name in ("matrix", "distortion", "base_T_camera"):
        _close(getattr(camera_log.camera, name), getattr(expected.camera, name))
    assert camera_log.mount is None
    boxes, true = camera_log.detections, expected.detections
    _close(boxes.frame_stamps, true.frame_stamps)
    assert np.array_equal(boxes.frame, true.frame)
    _close(boxes.boxes, true.boxes)
    _close(boxes.scores, true.scores)
    seen = sorted(set(true.label.tolist()))
    names = [str(i) for i in seen] if maker.ros1 else [true.label_names[i] for i in seen]
    assert boxes.label_names == tuple(names)
    assert np.array_equal(np.array(seen)[boxes.label], true.label)


@pytest.mark.parametrize("kind", ["1-bag", "4-sqlite3", "4-mcap-none", "4-mcap-zstd"])
def test_the_same_map_as_from_the_folder(tmp_path, makers, log, kind):
    vision, _, storage = kind.partition("-")
    maker = makers[vision]
    write_log_folder(log, tmp_path / "log")
    path = write_bag(tmp_path / "drive", storage, maker, rows_of(log, maker))
    settings = load_settings(None, ("mode=fixed", "association.method=by_label", "triangulation.device=cpu", *HELD))
    maps = [
        pipeline.run(source, settings, Ledger()).map.objects
        for source in (read_log_folder(tmp_path / "log", Ledger()), read(path, Ledger()))
    ]
    assert len(maps[0]) == len(maps[1]) >= 3
    for expected, found in zip(*maps, strict=True):
        assert found.status == expected.status
        np.testing.assert_allclose(found.position, expected.position, atol=1e-6)


def test_convert_and_read_again(tmp_path, makers, log):
    path = write_bag(tmp_path / "drive", "mcap-zstd", makers["4"], rows_of(log, makers["4"]))
    found = read(path, Ledger(), SourceOptions(format="ros"))
    write_log_folder(found, tmp_path / "log")
    again = read_log_folder(tmp_path / "log", Ledger())
    _same_path(again.odometry, found.odometry)
    assert np.array_equal(again.cameras[0].detections.boxes, found.cameras[0].detections.boxes)


def test_a_bag_without_a_camera_gives_its_path_and_the_mounts_and_with_boxes_beside_them_a_log(tmp_path, makers, log):
    maker = makers["4"]
    rows = [row for row in rows_of(log, maker) if not row[0].startswith("/front/")]
    ledger = Ledger()
    convert(write_bag(tmp_path / "drive", "mcap-none", maker, rows), tmp_path / "log", ledger, SourceOptions())
    assert sorted(file.name for file in (tmp_path / "log").iterdir()) == ["localization.txt", "mounts.yaml", "odometry.txt"]
    (warning,) = ledger.warnings
    assert warning.endswith("add a camera.yaml and a detections.jsonl to odometry.txt, localization.txt, mounts.yaml")
    (mount,) = read_mounts(tmp_path / "log" / "mounts.yaml")
    assert mount.name == "front_optical_frame"
    _close(mount.base_T_camera, log.cameras[0].camera.base_T_camera)
    write_camera(log.cameras[0].camera, tmp_path / "log" / "camera.yaml")
    write_detections(log.cameras[0].detections, tmp_path / "log" / "detections.jsonl")
    found = read(tmp_path / "log", Ledger())
    _same_path(found.odometry, log.odometry)
    _same_path(found.localization, log.localization)
    _close(found.cameras[0].detections.boxes, log.cameras[0].detections.boxes)


@pytest.mark.parametrize("given", ["CameraInfo", "file"])
def test_a_bag_without_boxes_and_images_gives_the_camera_and_with_boxes_beside_it_a_log(tmp_path, makers, log, given):
    maker, camera = makers["4"], log.cameras[0].camera
    rows = [row for row in rows_of(log, maker) if row[0] != "/front/detections"]
    options = SourceOptions()
    if given == "file":
        rows = [row for row in rows if row[0] not in ("/front/camera_info", "/tf_static")]
        write_camera(camera, tmp_path / "given.yaml")
        options = SourceOptions(camera_info=tmp_path / "given.yaml", base_frame="base_footprint")
    path, ledger = write_bag(tmp_path / "drive", "mcap-none", maker, rows), Ledger()
    with pytest.raises(LogError, match="`objslam convert` makes a log of this bag"):
        read(path, Ledger(), options)
    convert(path, tmp_path / "log", ledger, options)
    (warning,) = ledger.warnings
    assert warning.endswith("add a detections.jsonl to odometry.txt, localization.txt, camera.yaml")
    write_detections(log.cameras[0].detections, tmp_path / "log" / "detections.jsonl")
    (found,) = read(tmp_path / "log", Ledger()).cameras
    for name in ("matrix", "distortion", "base_T_camera"):
        _close(getattr(found.camera, name), getattr(camera, name))


def test_a_bag_with_the_calibrations_of_two_cameras_gives_both_and_topic_takes_one(tmp_path, makers):
    log = simulated(cameras=(make_camera("front"), make_camera("left", yaw=1.0)))
    maker = makers["4"]
    rows = [row for row in rows_of(log, maker) if not row[0].endswith("/detections")]
    path = write_bag(tmp_path / "drive", "mcap-none", maker, rows)
    names = sorted(camera_log.camera.name for camera_log in log.cameras)
    convert(path, tmp_path / "both", Ledger(), SourceOptions())
    assert sorted(file.parent.name for file in (tmp_path / "both" / "cameras").glob("*/camera.yaml")) == names
    convert(path, tmp_path / "one", Ledger(), SourceOptions(topics=(f"camera_info=/{names[1]}/camera_info",)))
    assert f"camera_name: {names[1]}" in (tmp_path / "one" / "camera.yaml").read_text()
