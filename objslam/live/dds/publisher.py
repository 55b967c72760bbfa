"""Publishes a session's map over DDS for RViz and Nav2: objects, markers and the corrected path."""

import math
from typing import Any

import numpy as np

from objslam.core.snapshot import Snapshot
from objslam.live.dds.network import Network
from objslam.live.dds.types import dds_topic, layouts_of
from objslam.output.export.map_messages import MapMessages

TOPICS = {
    "objects": "vision_msgs/msg/Detection3DArray",
    "markers": "visualization_msgs/msg/MarkerArray",
    "path": "nav_msgs/msg/Path",
}
"""The ROS types of the published messages, by their topic below the prefix."""
_MAX_PATH = 500  # The most poses of a published path. With a larger number, long paths delay the mapping.


class DdsPublisher:
    """Publishes snapshots on topics below a prefix. Unresolved objects are left out.

    The topics are transient-local, so a later subscriber receives the last message. Call `publish` from one thread only.
    """

    def __init__(self, network: Network, prefix: str = "/objslam") -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        # A stuck subscriber must not delay the session. So a write never waits, and only the last message is kept.
        qos = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
        self.topics = {name: f"{prefix.rstrip('/')}/{name}" for name in TOPICS}
        self._writers: dict[str, Any] = {}
        for name, type_ in TOPICS.items():
            topic: Any = Topic(network.participant, dds_topic(self.topics[name]), layouts_of(type_)[0])
            self._writers[name] = DataWriter(network.participant, topic, qos=qos)

    def publish(self, snapshot: Snapshot) -> None:
        """Publish a snapshot's objects, markers and path."""
        maker = MapMessages(snapshot.map.frame)
        for name, message in messages_of(snapshot, maker).items():
            data = bytes(maker.store.serialize_cdr(message, TOPICS[name]))
            self._writers[name].write(layouts_of(TOPICS[name])[0](data))


def messages_of(snapshot: Snapshot, maker: MapMessages) -> dict[str, Any]:
    """Return the messages of a snapshot by the names in TOPICS. The path is thinned to at most _MAX_PATH poses."""
    stamp = snapshot.stamp if math.isfinite(snapshot.stamp) else 0.0
    stamps, poses = snapshot.path.stamps, snapshot.path.poses
    step = max(1, math.ceil(len(stamps) / _MAX_PATH))
    chosen = np.arange(len(stamps) - 1, -1, -step)[::-1]
    return {
        "objects": maker.detections(stamp, snapshot.map.resolved()),
        "markers": maker.markers(stamp, snapshot.map, clear_first=True),
        "path": maker.path(stamp, stamps[chosen], poses[chosen]),
    }
