"""The options of ROS messages, which are recorded or live, and the options of bags."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from objslam.sources.options import Label, Option, WithRange

_TOPIC = """ROS bags, dds, rclpy: the topic for a role (odometry, localization, detections, image, depth, camera_info). \
With several cameras: CAMERA.ROLE=/NAME. ROLE=none uses no topic. ROLE=tf takes the path from tf. May be repeated."""
_RECTIFIED = "ROS bags, dds, rclpy: whether images and boxes are rectified or raw. Default: by topic name."
_CALIBRATION = """ROS bags, dds, rclpy: a calibration file like camera.yaml. Several cameras are below `cameras:`. A file \
with base_T_camera alone gives the mount of the camera."""
_BASE = "ROS bags, dds, rclpy: the name of the robot's base frame."


@dataclass(frozen=True)
class RosOptions:
    """The options of ROS messages in bags and in live sessions."""

    topics: Annotated[tuple[str, ...], Option("--topic", _TOPIC, metavar="ROLE=/NAME")] = ()
    camera_info: Annotated[Path | None, Option("--camera-info", _CALIBRATION)] = None
    base_frame: Annotated[str | None, Option("--base-frame", _BASE)] = None
    rectified: Annotated[bool | None, Option("--rectified/--raw", _RECTIFIED)] = None
    label: Label = None


@dataclass(frozen=True)
class BagOptions(RosOptions):
    """The options of bags.

    extract: the folder for the images. With None, they go into a temporary folder that is removed when the program ends.
    with_images: whether images are read. with_range: whether boxes get depths from the depth images.
    """

    extract: Path | None = None
    with_images: bool = True
    with_range: WithRange = True
