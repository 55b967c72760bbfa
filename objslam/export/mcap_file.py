"""MCAP with ROS 2 messages: the map and the path, for Foxglove, RViz (`ros2 bag play`) and anything that reads ROS 2 bags.

https://mcap.dev/spec, https://docs.ros.org/en/rolling/p/vision_msgs. No ROS is needed to write it.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

from objslam.errors import OutputError
from objslam.export.content import Content
from objslam.map_messages import MapMessages

OBJECTS, MARKERS, PATH, POSE = "/objslam/objects", "/objslam/markers", "/objslam/path", "/objslam/pose"
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  liveliness_lease_duration:\n"
    "    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false"
)
"""Offered QoS as rosbag2 records it: reliable, transient local. So RViz gets the map whenever it joins."""
_STAMPS = (0.0, 2.0**31)
"""s; builtin_interfaces/Time holds no others."""


def dump(content: Content) -> bytes:
    """The content of the file: objects, markers and path once, at the start; the robot's pose at each stamp of the path.

    Detections are the resolved objects with their covariances, all in one message. Chunks carry CRCs. OutputError where the
    stamps are no ROS time.
    """
    from mcap.writer import CompressionType, Writer

    stamps = content.path.stamps
    if len(stamps) and not (_STAMPS[0] <= stamps[0] and stamps[-1] < _STAMPS[1]):
        raise OutputError("stamps that are no ROS time, before 1970 or after 2038", where=str(content.out))
    maker = MapMessages(content.objects.frame)
    start = float(stamps[0]) if len(stamps) else 0.0
    shown = content.objects.resolved()
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="objslam")
    put = _channels(writer, maker)
    put(OBJECTS, start, maker.detections(start, shown))
    put(MARKERS, start, maker.markers(start, content.objects))
    put(PATH, start, maker.path(start, stamps, content.path.poses))
    for stamp, pose in zip(stamps.tolist(), content.path.poses, strict=True):
        put(POSE, stamp, maker.stamped(stamp, pose))
    writer.finish()
    return buffer.getvalue()


def _channels(writer: Any, maker: MapMessages) -> Callable[[str, float, Any], None]:
    """A function that writes a message to a topic, which it registers with its type when it is met first."""
    channels: dict[str, int] = {}

    def put(topic: str, stamp: float, message: Any) -> None:
        name = message.__msgtype__
        if topic not in channels:
            text, _ = maker.store.generate_msgdef(name, ros_version=2)
            schema = writer.register_schema(name, "ros2msg", text.encode())
            metadata = {} if topic == POSE else {"offered_qos_profiles": _LATCHED}
            channels[topic] = writer.register_channel(topic, "cdr", schema, metadata)
        at = round(stamp * 1e9)
        writer.add_message(channels[topic], at, bytes(maker.store.serialize_cdr(message, name)), at)

    return put
