"""The names of the message types that objslam reads, in ROS 2 form."""

ODOMETRY, IMAGE, COMPRESSED = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
CAMERA_INFO, DETECTIONS = "sensor_msgs/msg/CameraInfo", "vision_msgs/msg/Detection2DArray"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
IMAGES = (IMAGE, COMPRESSED)
LATCHED = (*TRANSFORMS, CAMERA_INFO)
"""The types whose publishers may send only one message, which may come before objslam subscribes."""


def is_tags(type_: str) -> bool:
    """Return whether a type is an array of AprilTag detections of any package."""
    package, _, name = type_.partition("/msg/")
    return "apriltag" in package and name.endswith(("Array", "ArrayStamped"))


def is_boxes(type_: str) -> bool:
    """Return whether messages of a type contain boxes, either detections or AprilTags."""
    return type_ == DETECTIONS or is_tags(type_)


def is_read(type_: str) -> bool:
    """Return whether objslam reads messages of a type."""
    return type_ in (ODOMETRY, CAMERA_INFO, *POSES, *IMAGES, *TRANSFORMS) or is_boxes(type_)
