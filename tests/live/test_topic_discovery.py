"""Which of the topics that exist are taken."""

import sys
from pathlib import Path

import numpy as np
import pytest
from robot import Recorder

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker

from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import TopicChoice
from objslam.sources.ros_bag.options import RosOptions

OFFERED = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf_old": "tf2_msgs/msg/TFMessage",
    "/odometry/filtered": "nav_msgs/msg/Odometry",
    "/odom": "nav_msgs/msg/Odometry",
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/front/camera_info": "sensor_msgs/msg/CameraInfo",
    "/front/image_raw": "sensor_msgs/msg/Image",
    "/front/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/front/depth/image": "sensor_msgs/msg/Image",
    "/ui": "sensor_msgs/msg/Image",
    "/front/detections": "vision_msgs/msg/Detection2DArray",
    "/tags": "apriltag_msgs/msg/AprilTagDetectionArray",
    "/scan": "sensor_msgs/msg/LaserScan",
}
ALWAYS = {"/tf", "/tf_static", "/front/camera_info"}


def wanted(*choices, images=False, settled=True, messages=None):
    messages = messages or RosMessages(Recorder(), RosOptions(topics=choices))
    return TopicChoice(messages.chosen, images).wanted(OFFERED, messages, settled), messages.ledger.warnings


@pytest.mark.parametrize(
    ("choices", "images", "more"),
    [
        ((), False, {"/odom", "/front/detections", "/tags"}),
        ((), True, {"/odom", "/front/image_raw"}),
        (("odometry=/odometry/filtered", "detections=/tags"), False, {"/odometry/filtered", "/tags"}),
        (("odometry=tf", "detections=none"), False, set()),
        (("localization=/amcl_pose",), False, {"/amcl_pose", "/odom", "/front/detections", "/tags"}),
        (("image=/ui", "detections=/tags"), True, {"/odom", "/ui", "/tags"}),
        (("depth=/front/depth/image", "detections=/tags"), False, {"/odom", "/front/depth/image", "/tags"}),
    ],
)
def test_topics_by_type_and_choice(choices, images, more):
    assert wanted(*choices, images=images)[0] == ALWAYS | more


def test_namespaces_are_chosen():
    offered = {
        f"/{robot}/{name}": "tf2_msgs/msg/TFMessage" for robot in ("robot1", "robot2") for name in ("tf", "tf_static")
    }
    messages = RosMessages(Recorder(), RosOptions(topics=("tf=/robot1/tf", "tf_static=/robot1/tf_static")))
    assert TopicChoice(messages.chosen).wanted(offered, messages, True) == {"/robot1/tf", "/robot1/tf_static"}


def _of_robots(*robots):
    types = {
        "tf": OFFERED["/tf"],
        "tf_static": OFFERED["/tf"],
        "odom": OFFERED["/odom"],
        "nn/boxes": OFFERED["/front/detections"],
    }
    return {f"/{robot}/{name}": type_ for robot in robots for name, type_ in types.items()}


@pytest.mark.parametrize(
    ("choices", "robot"),
    [
        ((), "r1"),
        (("odometry=/r2/odom",), "r2"),
        (("tf=/r2/tf", "tf_static=/r2/tf_static", "odometry=/r2/odom"), "r2"),
    ],
)
def test_of_several_robots_all_topics_of_one_are_taken(choices, robot):
    """They have frames of the same names. The second robot may be the first that is heard."""
    messages = RosMessages(Recorder(), RosOptions(topics=choices))
    choice = TopicChoice(messages.chosen)
    if not choices:
        assert choice.wanted(_of_robots("r2"), messages, settled=False) == set()
    offered = {**_of_robots("r2", "r1"), "/camera_info": OFFERED["/front/camera_info"]}
    assert choice.wanted(offered, messages, settled=True) == {*_of_robots(robot), "/camera_info"}
    other = "r1" if robot == "r2" else "r2"
    said = f"several fit tf: /{robot}/tf is taken, not /{other}/tf (--topic tf=... chooses)"
    assert (said in messages.ledger.warnings) == (choices[:1] != ("tf=/r2/tf",))


def test_one_robot_in_a_namespace_needs_no_choice_and_one_that_starts_later_changes_nothing():
    messages = RosMessages(Recorder())
    choice = TopicChoice()
    assert choice.wanted(_of_robots("robot9"), messages, settled=True) == set(_of_robots("robot9"))
    assert not messages.ledger.warnings
    assert choice.wanted(_of_robots("r1", "robot9"), messages, settled=True) == set(_of_robots("robot9"))
    both = {**_of_robots("r1"), "/tf": OFFERED["/tf"]}  # a relay, or transforms in both
    assert choice.wanted(both, messages, settled=True) == set(both)


def test_a_chosen_topic_that_nobody_publishes_is_said_once_with_those_that_fit():
    messages = RosMessages(Recorder(), RosOptions(topics=("detections=/boxes", "odometry=tf", "tf=/r1/tf", "depth=none")))
    choice = TopicChoice(messages.chosen)
    for _ in range(2):
        choice.warn_of_absent(OFFERED, messages.ledger)
    choice.warn_of_absent({}, messages.ledger)
    assert messages.ledger.warnings == [
        "--topic detections=/boxes: nobody publishes /boxes (topics that fit detections: /front/detections, /tags)",
        "--topic tf=/r1/tf: nobody publishes /r1/tf (topics that fit tf: /tf, /tf_old, /tf_static)",
    ]


def test_one_of_several_is_taken_when_all_are_known_and_that_is_said():
    assert wanted(settled=False) == (ALWAYS | {"/front/detections", "/tags"}, [])
    _, warnings = wanted()
    assert warnings == [
        "several fit odometry: /odom is taken, not /odometry/filtered (--topic odometry=... chooses)",
    ]
    _, warnings = wanted(images=True)
    assert warnings[1].startswith("several fit image: /front/image_raw is taken, not /front/image_raw/compressed, /ui")


def test_odometry_in_map_makes_way_for_one_that_drifts():
    messages = RosMessages(Recorder())
    assert "/odom" in wanted(messages=messages)[0]
    messages.receive("nav_msgs/msg/Odometry", "/odom", Maker().odometry(10**9, np.eye(4), frame="map"), 1.0)
    assert {"/odom", "/odometry/filtered"} <= wanted(messages=messages)[0]
