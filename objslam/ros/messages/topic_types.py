"""The message types that matter here, as ROS 2 writes them."""

from __future__ import annotations

ODOMETRY, IMAGE, COMPRESSED = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
CAMERA_INFO, DETECTIONS = "sensor_msgs/msg/CameraInfo", "vision_msgs/msg/Detection2DArray"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
IMAGES = (IMAGE, COMPRESSED)

LATCHED = (*TRANSFORMS, CAMERA_INFO)
"""Types whose past messages matter too: a publisher sends them once, or hands them to whoever comes later."""


def is_tags(type_: str) -> bool:
    """Whether a type is an array of AprilTag detections, of whatever package."""
    package, _, name = type_.partition("/msg/")
    return "apriltag" in package and name.endswith(("Array", "ArrayStamped"))


def is_boxes(type_: str) -> bool:
    """Whether messages of a type hold boxes: detections or tags."""
    return type_ == DETECTIONS or is_tags(type_)
