"""What `describe` says of a recording."""

import numpy as np
import pytest
from bag_writer import write_bag
from drive_bag import rows_of, simulated

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.sources.ros_bag.info import describe
from objslam.sources.ros_bag.log import read_bag
from objslam.sources.ros_bag.options import BagOptions


@pytest.fixture(scope="module")
def log():
    return simulated()


@pytest.mark.parametrize("kind", ["bag", "sqlite3", "mcap-zstd"])
def test_a_drive_at_a_glance(makers, tmp_path, log, kind):
    maker = makers["1" if kind == "bag" else "4"]
    rows = [row for row in rows_of(log, maker) if row[0] != "/odom" or not 3 < (row[1] / 1e9 - log.odometry.stamps[0]) < 5]
    rows.append(("/chatter", rows[-1][1] + 10**9, maker.make("std_msgs/String", "hello")))
    info = describe(write_bag(tmp_path / "drive", kind, maker, rows))
    assert info.name == "drive"
    assert info.format == {"bag": "ROS 1 bag", "sqlite3": "ROS 2 sqlite3", "mcap-zstd": "MCAP"}[kind]
    assert (info.messages, info.lost) == (len(rows), 0)
    assert info.missing == info.damage == info.warnings == ()
    topics = {topic.name: topic for topic in info.topics}
    assert {name: topic.role for name, topic in topics.items()} == {
        "/odom": "odometry",
        "/amcl_pose": "localization",
        "/front/detections": "detections",
        "/front/camera_info": "camera_info",
        "/tf_static": "tf_static",
        "/chatter": "",
    }
    odometry = topics["/odom"]
    assert odometry.type == "nav_msgs/msg/Odometry"
    assert odometry.frame == "odom"
    assert odometry.detail == "odom -> base_footprint"
    assert odometry.messages == sum(1 for topic, _, _ in rows if topic == "/odom")
    np.testing.assert_allclose([odometry.timing.start, odometry.timing.end], log.odometry.stamps[[0, -1]], atol=1e-9)
    assert 2.0 <= odometry.timing.longest_gap <= 2.1
    span = odometry.timing.end - odometry.timing.start
    assert np.isclose(odometry.timing.rate, (odometry.messages - 1) / span)
    assert topics["/front/detections"].detail.startswith(f"{len(log.cameras[0].detections)} boxes of")
    assert topics["/front/camera_info"].timing.rate == 0
    assert (info.base, info.odometry, info.localization) == ("base_footprint", "/odom", "/amcl_pose")
    (place,) = info.places
    assert place.chain == ("base_footprint", "base_link", "front_link", "front_optical_frame")
    np.testing.assert_allclose(place.base_T_frame, log.cameras[0].camera.base_T_camera, atol=1e-12)
    assert info.cameras[0].name == "front"
    assert np.isclose(info.end - info.start, (rows[-1][1] - rows[0][1]) / 1e9)


def test_images_without_detections_need_a_detector(makers, tmp_path, log):
    maker = makers["4"]
    rows = [row for row in rows_of(log, maker) if "detections" not in row[0]]
    image = maker.image(rows[-1][1] - 10**9, np.zeros((480, 640, 3), np.uint8), "bgr8", "front_optical_frame")
    info = describe(write_bag(tmp_path / "x", "mcap-zstd", maker, [*rows, ("/front/image_raw", rows[-1][1], image)]))
    assert info.missing == ("camera front: no detections; run a detector on its images (--detector)",)
    (topic,) = [topic for topic in info.topics if topic.name == "/front/image_raw"]
    assert (topic.role, topic.detail) == ("image", "640x480 bgr8")


def test_frames_of_another_clock(makers, tmp_path, log):
    maker = makers["4"]
    rows = [row for row in rows_of(log, maker) if "detections" not in row[0]]
    stamp = 10**9
    rows.append(
        ("/front/detections", rows[-1][1], maker.detections(stamp, [(0, 0, 9, 9, "cup", 0.5)], "front_optical_frame"))
    )
    (line,) = describe(write_bag(tmp_path / "x", "mcap-none", maker, rows)).missing
    assert line.startswith("camera front: none of its frames (1.000 to 1.000 s) is within the time of the path")


def test_all_that_is_missing_is_listed(makers, tmp_path):
    maker = makers["4"]
    rows = [("/detections", 10**9, maker.detections(10**9, [(0, 0, 1, 1, "cup", 0.5)]))]
    path = write_bag(tmp_path / "x", "mcap-none", maker, rows)
    info = describe(path)
    assert [line.split(" (")[0] for line in info.missing] == [
        "x: there is neither odometry nor localisation",
        "camera camera: no CameraInfo belongs to this camera",
    ]
    assert info.topics[0].role == "detections"
    assert (info.base, info.odometry, info.places) == ("", "", ())
    with pytest.raises(LogError, match="neither odometry nor localisation"):
        read_bag(path, Ledger())


def test_messages_that_cannot_be_used_are_counted(makers, tmp_path, log):
    from bag_writer import Raw

    maker = makers["4"]
    rows = rows_of(log, maker)
    rows.append(("/odom", rows[-1][1], Raw(b"\0\1\0\0garbage", "nav_msgs/msg/Odometry")))
    path = write_bag(tmp_path / "x", "mcap-none", maker, rows)
    (topic,) = [topic for topic in describe(path).topics if topic.name == "/odom"]
    assert topic.messages == len(log.odometry) + 1
    assert topic.refused == ("1 shorter than a header",)
    ledger = Ledger()
    assert len(read_bag(path, ledger).odometry) == len(log.odometry)
    assert ledger.dropped == {"message that cannot be used: shorter than a header": 1}
    assert ledger.examples == {"message that cannot be used: shorter than a header": ["/odom"]}


def test_an_empty_recording(makers, tmp_path):
    path = write_bag(tmp_path / "x", "mcap-none", makers["4"], [])
    info = describe(path, BagOptions())
    assert (info.messages, info.topics, info.end - info.start) == (0, (), 0)
    assert len(info.missing) == 2
