"""Message definitions that neither the type library nor bags before ROS 2 Iron contain.

The definitions are from the documentation of the packages. Messages of vision_msgs 3.x and 4.x have the same bytes. Messages
of vision_msgs 2.x (Foxy) have other bytes.
"""

_TYPES = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Pose2D": "float64 x\nfloat64 y\nfloat64 theta\n",
    "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data\n",
    "vision_msgs/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "apriltag_msgs/Point": "float64 x\nfloat64 y\n",
}
_VISION_MSGS_2 = {
    "vision_msgs/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
}
_RESULTS = "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/"
_IMAGE_AND_TRACK = "sensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id\n"
_TAG = (
    "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
    "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n"
)


def _array(element: str, fields: str, types: dict[str, str] = _TYPES) -> str:
    """Return the definition of a message with an array of detections, and the definitions of all types it may use. The text
    has the form that bags store. element: the type of a detection. fields: the definition of this type."""
    parts = "".join(f"{'=' * 80}\nMSG: {name}\n{part}" for name, part in {**types, element: fields}.items())
    return f"std_msgs/Header header\n{element}[] detections\n{parts}"


VISION_MSGS_3D = _array("vision_msgs/Detection3D", _RESULTS + "BoundingBox3D bbox\nstring id\n")
"""The definition of Detection3DArray in vision_msgs 4.x, which the export of maps writes."""
KNOWN: dict[str, tuple[str, ...]] = {
    "vision_msgs/msg/Detection2DArray": (
        _array("vision_msgs/Detection2D", _RESULTS + "BoundingBox2D bbox\nstring id\n"),
        _array("vision_msgs/Detection2D", f"{_RESULTS}BoundingBox2D bbox\n{_IMAGE_AND_TRACK}", _TYPES | _VISION_MSGS_2),
    ),
    "vision_msgs/msg/Detection3DArray": (VISION_MSGS_3D,),
    "apriltag_msgs/msg/AprilTagDetectionArray": (_array("apriltag_msgs/AprilTagDetection", _TAG),),
}
"""The possible definitions of each message type. A message fits only one definition, because the definition must use all
bytes of the message."""
