"""The MCAP format with ROS 2 messages: map and path, for Foxglove, RViz (`ros2 bag play`) and readers of ROS 2 bags.

ROS is not needed. Source: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from objslam.errors import OutputError
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.output.export.content import Content

_POSE_TOPIC = "/objslam/pose"  # The topic with the robot's pose at each stamp. Every other topic has one latched message.
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  liveliness_lease_duration:\n"
    "    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false"
)
"""The offered QoS in the form of rosbag2. It is reliable and transient local, so an RViz that starts later gets the map."""


def _dump(content: Content) -> bytes:
    """Return the content of the MCAP file. Raises OutputError if a stamp of the path is before 1970 or after 2038.

    One message has all resolved objects with their covariances, one has all markers, and one has the whole path. These three
    messages have the first stamp of the path. For each stamp of the path, one message has the robot's pose. Each chunk has
    a CRC.
    """
    from mcap.writer import CompressionType, Writer

    from objslam.output.export.map_messages import LAST_STAMP, MapMessages

    stamps = content.path.stamps
    if len(stamps) and not 0.0 <= stamps[0] <= stamps[-1] < LAST_STAMP:  # An MCAP file has no negative stamps.
        raise OutputError("the stamps are no ROS time: they lie before 1970 or after 2038", where=str(content.out))
    messages = MapMessages(content.objects.frame)
    start = float(stamps[0]) if len(stamps) else 0.0
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="objslam")
    channels: dict[str, int] = {}

    def put(topic: str, stamp: float, message: Any) -> None:
        name = message.__msgtype__
        if topic not in channels:
            text, _ = messages.store.generate_msgdef(name, ros_version=2)
            schema = writer.register_schema(name, "ros2msg", text.encode())
            metadata = {} if topic == _POSE_TOPIC else {"offered_qos_profiles": _LATCHED}
            channels[topic] = writer.register_channel(topic, "cdr", schema, metadata)
        at = round(stamp * 1e9)
        writer.add_message(channels[topic], at, bytes(messages.store.serialize_cdr(message, name)), at)

    put("/objslam/objects", start, messages.detections(start, content.objects.resolved()))
    put("/objslam/markers", start, messages.markers(start, content.objects))
    put("/objslam/path", start, messages.path(start, stamps, content.path.poses))
    for stamp, pose in zip(stamps.tolist(), content.path.poses, strict=True):
        put(_POSE_TOPIC, stamp, messages.stamped(stamp, pose))
    writer.finish()
    return buffer.getvalue()


EXPORT = ExportFormat("mcap", "map.mcap", "map and path as ROS 2 messages, for Foxglove and RViz", _dump)
