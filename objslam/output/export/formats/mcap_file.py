"""MCAP with ROS 2 messages: the map and the path, for Foxglove, RViz (`ros2 bag play`) and anything that reads ROS 2 bags.

https://mcap.dev/spec, https://docs.ros.org/en/rolling/p/vision_msgs. No ROS is needed to write it.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from objslam.errors import OutputError
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.output.export.content import Content
    from objslam.output.export.map_messages import MapMessages

_POSE_TOPIC = "/objslam/pose"
"""The topic of the robot's pose: the only one with a message per stamp."""

_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  liveliness_lease_duration:\n"
    "    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false"
)
"""The offered QoS as rosbag2 records it: reliable and transient local, so that RViz gets the map whenever it joins."""

_LAST_STAMP = 2.0**31
"""The stamp, s, from which builtin_interfaces/Time overflows; it also has no stamp below 0."""


def _dump(content: Content) -> bytes:
    """The content of the file: objects, markers and path once, at the start; the robot's pose at each stamp of the path.

    One message holds all resolved objects with their covariances. Chunks carry CRCs.
    """
    from mcap.writer import CompressionType, Writer

    from objslam.output.export.map_messages import MapMessages

    stamps = content.path.stamps
    if len(stamps) and not 0.0 <= stamps[0] <= stamps[-1] < _LAST_STAMP:
        raise OutputError("stamps that are no ROS time, before 1970 or after 2038", where=str(content.out))
    messages = MapMessages(content.objects.frame)
    start = float(stamps[0]) if len(stamps) else 0.0
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="objslam")
    put = _channels(writer, messages)
    put("/objslam/objects", start, messages.detections(start, content.objects.resolved()))
    put("/objslam/markers", start, messages.markers(start, content.objects))
    put("/objslam/path", start, messages.path(start, stamps, content.path.poses))
    for stamp, pose in zip(stamps.tolist(), content.path.poses, strict=True):
        put(_POSE_TOPIC, stamp, messages.stamped(stamp, pose))
    writer.finish()
    return buffer.getvalue()


def _channels(writer: Any, messages: MapMessages) -> Callable[[str, float, Any], None]:
    """A function that writes a message to a topic; a topic and its type are registered with their first message."""
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

    return put


EXPORT = ExportFormat("mcap", "map.mcap", "map and path as ROS 2 messages, for Foxglove and RViz", _dump)
