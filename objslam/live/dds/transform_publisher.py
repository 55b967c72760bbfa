"""Publishes the tf transform from the map to the odometry over DDS, so that other nodes can place the map's objects."""

import math
from collections.abc import Callable
from typing import Any

from objslam.core.arrays import Floats
from objslam.core.snapshot import Snapshot
from objslam.live.dds.network import Network
from objslam.live.dds.types import dds_topic, layouts_of
from objslam.output.export.map_messages import MapMessages

_TYPE = "tf2_msgs/msg/TFMessage"
_QUEUE = 100  # The most transforms that wait for a slow subscriber, as in tf2. A larger number costs memory.
_AHEAD = 0.2
"""The time, s, by which the stamp of a transform is later than the newest pose. tf2 does not extrapolate, so the stamp must
be ahead. Transforms are 0.1 s apart, so 0.2 s bridge one late transform. A larger value keeps an old transform in use for
longer."""


class TransformPublisher:
    """Publishes the newest `Snapshot.map_T_odom` on /tf. Call its methods from one thread only.

    odom_frame: returns the frame of the odometry, or None if this frame is unknown or has another parent. tf allows only one
    parent.
    """

    def __init__(self, network: Network, odom_frame: Callable[[], str | None], topic: str = "/tf") -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        self._odom_frame = odom_frame
        self._newest: Floats | None = None
        self._messages, self._layout = MapMessages(""), layouts_of(_TYPE)[0]
        qos = Qos(Policy.Reliability.Reliable(0), Policy.Durability.Volatile, Policy.History.KeepLast(_QUEUE))
        at: Any = Topic(network.participant, dds_topic(topic), self._layout)
        self._writer: Any = DataWriter(network.participant, at, qos=qos)

    def update(self, snapshot: Snapshot) -> None:
        """Take map_T_odom of a snapshot. If the snapshot has none, the last one is kept."""
        if snapshot.map_T_odom is not None:
            self._newest, self._messages.frame = snapshot.map_T_odom, snapshot.map.frame

    def send(self, stamp: float) -> None:
        """Publish the transform if it is known. stamp: the stamp of the newest pose, s. The transform's stamp is `_AHEAD`
        later."""
        child = self._odom_frame()
        if self._newest is None or child is None or not math.isfinite(stamp):
            return
        message = self._messages.transform(stamp + _AHEAD, child, self._newest)
        self._writer.write(self._layout(bytes(self._messages.store.serialize_cdr(message, _TYPE))))
