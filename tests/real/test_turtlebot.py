"""A real ROS 2 recording (sqlite3, Galactic): what `describe` says, against the file and the robot's description."""

import sqlite3

import numpy as np
import pytest

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.sources import read
from objslam.sources.ros_bag.info import describe


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "turtlebot_ros2_bag"


def test_topics_and_times(folder):
    info = describe(folder)
    with sqlite3.connect(f"file:{folder / 'macfirst_floor_take_2_0.db3'}?immutable=1", uri=True) as database:
        query = "SELECT name, type, count(*) FROM topics JOIN messages ON topics.id = topic_id GROUP BY name"
        expected = {name: (kind, count) for name, kind, count in database.execute(query)}
    assert {topic.name: (topic.type, topic.messages) for topic in info.topics} == expected
    roles = {topic.name: topic.role for topic in info.topics if topic.role}
    assert roles == {"/odom": "odometry", "/tf": "tf", "/tf_static": "tf_static"}
    (odometry,) = [topic for topic in info.topics if topic.name == "/odom"]
    assert odometry.messages == 920
    assert odometry.detail == "odom -> base_link"
    assert 19.9 < odometry.timing.rate < 20.1
    assert 46.0 < info.end - info.start < 46.5
    assert (info.base, info.odometry, info.localization) == ("base_link", "/odom", "")
    assert (info.messages, info.lost, info.damage) == (2425, 0, ())


def test_the_chain_to_the_optical_frame(folder):
    (place,) = [p for p in describe(folder).places if p.frame == "oakd_lite_rgb_camera_optical_frame"]
    assert place.chain == (
        "base_link",
        "oakd_lite_camera_bracket",
        "oakd_lite_link",
        "oakd_lite_rgb_camera_frame",
        "oakd_lite_rgb_camera_optical_frame",
    )
    # By hand, from the numbers in /tf_static: a bracket 9 cm behind the centre at 0.0933 m, the camera 5.294 cm before and
    # 9.254 cm above it, both without a turn; then the turn from x forward, y left, z up to x right, y down, z forward.
    forward = -0.09 + 0.05294026
    up = 0.09334772 + 0.0925385
    expected = [[0, 0, 1, forward], [-1, 0, 0, 0], [0, -1, 0, up], [0, 0, 0, 1]]
    np.testing.assert_allclose(place.base_T_frame, expected, atol=1e-12)


def test_what_is_missing(folder):
    (missing,) = describe(folder).missing
    assert "no images and no detections" in missing
    with pytest.raises(LogError, match="no camera: the recording has no images and no detections"):
        read(folder, Ledger())
