"""Message definitions that bags before ROS 2 Iron do not contain and that the type library does not know.

The definitions follow the documentation of the packages. vision_msgs 3.x and 4.x have equal bytes. vision_msgs 2.x (Foxy)
has additional image and tracking fields. ROS 1 bags always contain their definitions.
"""

from __future__ import annotations

_RULE = "=" * 80
_HEADER = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
}
_POSE = {
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}
_HYPOTHESIS = {
    "vision_msgs/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score\n",
}
_RESULTS = "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"


def _array(element: str, fields: str, parts: dict[str, str]) -> str:
    """Return the definition of an array message, followed by the types that it refers to, as bags store it."""
    types = _HEADER | (_POSE if fields.startswith(_RESULTS) else {}) | {element: fields} | parts
    text = f"std_msgs/Header header\n{element}[] detections\n"
    return text + "".join(f"{_RULE}\nMSG: {name}\n{part}" for name, part in types.items())


_VISION_MSGS_4 = _array(
    "vision_msgs/Detection2D",
    f"{_RESULTS}vision_msgs/BoundingBox2D bbox\nstring id\n",
    _HYPOTHESIS
    | {
        "vision_msgs/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
        "vision_msgs/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
        "vision_msgs/Point2D": "float64 x\nfloat64 y\n",
    },
)
_VISION_MSGS_2 = _array(
    "vision_msgs/Detection2D",
    f"{_RESULTS}vision_msgs/BoundingBox2D bbox\nsensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id\n",
    {
        "vision_msgs/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
        "vision_msgs/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
        "geometry_msgs/Pose2D": "float64 x\nfloat64 y\nfloat64 theta\n",
        "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data\n",
    },
)
VISION_MSGS_3D = _array(
    "vision_msgs/Detection3D",
    f"{_RESULTS}vision_msgs/BoundingBox3D bbox\nstring id\n",
    _HYPOTHESIS
    | {
        "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    },
)
"""The definition of Detection3DArray in vision_msgs 4.x, which the export of maps writes."""

KNOWN: dict[str, tuple[str, ...]] = {
    "vision_msgs/msg/Detection2DArray": (_VISION_MSGS_4, _VISION_MSGS_2),
    "vision_msgs/msg/Detection3DArray": (VISION_MSGS_3D,),
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        _array(
            "apriltag_msgs/AprilTagDetection",
            "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
            "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n",
            {"apriltag_msgs/Point": "float64 x\nfloat64 y\n"},
        ),
    ),
}
"""The possible definitions of each type. A message fits only one of them, because a definition must use all its bytes."""
