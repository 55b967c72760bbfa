"""Message layouts that bags before ROS 2 Iron do not bring along and that the type library does not know.

Written from the packages' documentation. vision_msgs 3.x and 4.x are equal as bytes; 2.x (Foxy) still carries an image and
tracking fields; that of ROS 1 always lies in the bag itself.
"""

from __future__ import annotations

_RULE = "=" * 80


def _join(text: str, **parts: str) -> str:
    """A definition with those that it refers to, as bags write it."""
    return text + "".join(f"{_RULE}\nMSG: {name.replace('__', '/')}\n{part}" for name, part in parts.items())


_HEADER = {
    "std_msgs__Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces__Time": "int32 sec\nuint32 nanosec\n",
}
_POSE = {
    "geometry_msgs__PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs__Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs__Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs__Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}
_IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
)
_ARRAY = "std_msgs/Header header\n{} detections\n"

VISION_MSGS_4 = _join(
    _ARRAY.format("vision_msgs/Detection2D[]"),
    **_HEADER,
    **_POSE,
    vision_msgs__Detection2D="std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id\n",
    vision_msgs__ObjectHypothesisWithPose="vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    vision_msgs__ObjectHypothesis="string class_id\nfloat64 score\n",
    vision_msgs__BoundingBox2D="vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    vision_msgs__Pose2D="vision_msgs/Point2D position\nfloat64 theta\n",
    vision_msgs__Point2D="float64 x\nfloat64 y\n",
)
VISION_MSGS_2 = _join(
    _ARRAY.format("vision_msgs/Detection2D[]"),
    **_HEADER,
    **_POSE,
    vision_msgs__Detection2D="std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nsensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id\n",
    vision_msgs__ObjectHypothesisWithPose="string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    vision_msgs__BoundingBox2D="geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    geometry_msgs__Pose2D="float64 x\nfloat64 y\nfloat64 theta\n",
    sensor_msgs__Image=_IMAGE,
)
VISION_MSGS_3D = _join(
    _ARRAY.format("vision_msgs/Detection3D[]"),
    **_HEADER,
    **_POSE,
    vision_msgs__Detection3D="std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    vision_msgs__ObjectHypothesisWithPose="vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    vision_msgs__ObjectHypothesis="string class_id\nfloat64 score\n",
    vision_msgs__BoundingBox3D="geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    geometry_msgs__Vector3="float64 x\nfloat64 y\nfloat64 z\n",
)
"""Detection3DArray of vision_msgs 4.x, for maps that are written."""
APRILTAG_MSGS = _join(
    _ARRAY.format("apriltag_msgs/AprilTagDetection[]"),
    **_HEADER,
    apriltag_msgs__AprilTagDetection="string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
    "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n",
    apriltag_msgs__Point="float64 x\nfloat64 y\n",
)

KNOWN: dict[str, tuple[str, ...]] = {
    "vision_msgs/msg/Detection2DArray": (VISION_MSGS_4, VISION_MSGS_2),
    "vision_msgs/msg/Detection3DArray": (VISION_MSGS_3D,),
    "apriltag_msgs/msg/AprilTagDetectionArray": (APRILTAG_MSGS,),
}
"""By type, the layouts to try in turn: a message fits only one of them, since each must use up all its bytes."""
