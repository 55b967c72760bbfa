"""MCAP with ROS 2 messages: the map and the path, for Foxglove, RViz (`ros2 bag play`) and anything that reads ROS 2 bags.

https://mcap.dev/spec, https://docs.ros.org/en/rolling/p/vision_msgs. No ROS is needed to write it.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.errors import OutputError
from objslam.export.content import Content
from objslam.geometry import make_pose, quaternion
from objslam.scene import captions, ellipsoid, label_colours
from objslam.types import Floats, MapObject

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

OBJECTS, MARKERS, PATH, POSE = "/objslam/objects", "/objslam/markers", "/objslam/path", "/objslam/pose"
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  liveliness_lease_duration:\n"
    "    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false"
)
"""Offered QoS as rosbag2 records it: reliable, transient local. So RViz gets the map whenever it joins."""
_SPHERE, _TEXT, _ADD = 2, 9, 0
_SMALLEST = 0.05
"""m; smaller markers cannot be seen."""
_TEXT_SIZE = 0.15  # m
_STAMPS = (0.0, 2.0**31)
"""s; builtin_interfaces/Time holds no others."""


def dump(content: Content) -> bytes:
    """The content of the file: objects, markers and path once, at the start; the robot's pose at each stamp of the path.

    Detections are the resolved objects with their covariances, all in one message. A box is as wide as the object and as
    deep as it is wide, 0 where its size is unknown. Chunks carry CRCs. OutputError where the stamps are no ROS time.
    """
    from mcap.writer import CompressionType, Writer

    stamps = content.path.stamps
    if len(stamps) and not (_STAMPS[0] <= stamps[0] and stamps[-1] < _STAMPS[1]):
        raise OutputError("stamps that are no ROS time, before 1970 or after 2038", where=str(content.out))
    maker = _Maker(content.objects.frame)
    start = float(stamps[0]) if len(stamps) else 0.0
    shown = content.objects.resolved()
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="objslam")
    put = _channels(writer, maker)
    put(OBJECTS, start, maker.detections(start, shown))
    put(MARKERS, start, maker.markers(start, content))
    put(PATH, start, maker.path(start, stamps, content.path.poses))
    for stamp, pose in zip(stamps.tolist(), content.path.poses, strict=True):
        put(POSE, stamp, maker.stamped(stamp, pose))
    writer.finish()
    return buffer.getvalue()


def _channels(writer: Any, maker: _Maker) -> Callable[[str, float, Any], None]:
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


class _Maker:
    """Makes messages in one frame."""

    def __init__(self, frame: str) -> None:
        self.frame, self.store = frame, _typestore()

    def make(self, name: str, *values: Any) -> Any:
        package, _, plain = name.partition("/")
        return self.store.types[f"{package}/msg/{plain}"](*values)

    def header(self, stamp: float) -> Any:
        nanoseconds = round(stamp * 1e9)
        return self.make("std_msgs/Header", self.make("builtin_interfaces/Time", *divmod(nanoseconds, 10**9)), self.frame)

    def vector(self, kind: str, values: Floats) -> Any:
        return self.make(f"geometry_msgs/{kind}", *(float(value) for value in values))

    def pose(self, pose: Floats) -> Any:
        turn = self.vector("Quaternion", quaternion(pose[None])[0])
        return self.make("geometry_msgs/Pose", self.vector("Point", pose[:3, 3]), turn)

    def stamped(self, stamp: float, pose: Floats) -> Any:
        return self.make("geometry_msgs/PoseStamped", self.header(stamp), self.pose(pose))

    def path(self, stamp: float, stamps: Floats, poses: Floats) -> Any:
        stamped = [self.stamped(t, pose) for t, pose in zip(stamps.tolist(), poses, strict=True)]
        return self.make("nav_msgs/Path", self.header(stamp), stamped)

    def detections(self, stamp: float, objects: tuple[MapObject, ...]) -> Any:
        found = [self._detection(stamp, o) for o in objects]
        return self.make("vision_msgs/Detection3DArray", self.header(stamp), found)

    def _detection(self, stamp: float, o: MapObject) -> Any:
        pose = self.pose(make_pose(np.eye(3), o.position))
        covariance = np.zeros((6, 6))
        if o.covariance is not None:
            covariance[:3, :3] = o.covariance
        with_covariance = self.make("geometry_msgs/PoseWithCovariance", pose, covariance.ravel())
        shares = o.labels or {o.label: 1.0}
        results = [
            self.make(
                "vision_msgs/ObjectHypothesisWithPose", self.make("vision_msgs/ObjectHypothesis", *pair), with_covariance
            )
            for pair in shares.items()
        ]
        width, height = o.extent or (0.0, 0.0)
        box = self.make("vision_msgs/BoundingBox3D", pose, self.vector("Vector3", np.array([width, width, height])))
        return self.make("vision_msgs/Detection3D", self.header(stamp), results, box, str(o.id))

    def markers(self, stamp: float, content: Content) -> Any:
        """A ball where each object is, its covariance (2 sigma) around it, and its name above."""
        colours, made = label_colours(content.objects), []
        for number, (o, name) in enumerate(zip(content.objects.objects, captions(content.objects), strict=True)):
            if o.status != "ok":
                continue
            colour = colours[o.label]
            size = np.maximum([o.extent[0], o.extent[0], o.extent[1]] if o.extent else np.zeros(3), _SMALLEST)
            at = make_pose(np.eye(3), o.position)
            above = make_pose(np.eye(3), o.position + np.array([0.0, 0.0, size[2] / 2 + _TEXT_SIZE]))
            made.append(self._marker(stamp, "objects", number, _SPHERE, at, size, (*colour, 0.9)))
            made.append(self._marker(stamp, "labels", number, _TEXT, above, np.full(3, _TEXT_SIZE), (*colour, 1.0), name))
            axes = ellipsoid(o)
            if axes is not None:
                turned = make_pose(axes[1], o.position)
                made.append(self._marker(stamp, "covariances", number, _SPHERE, turned, 2 * axes[0], (*colour, 0.3)))
        return self.make("visualization_msgs/MarkerArray", made)

    def _marker(
        self,
        stamp: float,
        namespace: str,
        number: int,
        kind: int,
        pose: Floats,
        size: Floats,
        colour: tuple[float, ...],
        text: str = "",
    ) -> Any:
        make, never = self.make, self.make("builtin_interfaces/Duration", 0, 0)
        nothing = make("sensor_msgs/CompressedImage", self.header(stamp), "", np.zeros(0, dtype=np.uint8))
        mesh = make("visualization_msgs/MeshFile", "", np.zeros(0, dtype=np.uint8))
        values = {
            "header": self.header(stamp),
            "ns": namespace,
            "id": number,
            "type": kind,
            "action": _ADD,
            "pose": self.pose(pose),
            "scale": self.vector("Vector3", np.maximum(size, 1e-3)),
            "color": make("std_msgs/ColorRGBA", *(float(part) for part in colour)),
            "lifetime": never,
            "frame_locked": False,
            "points": [],
            "colors": [],
            "texture_resource": "",
            "texture": nothing,
            "uv_coordinates": [],
            "text": text,
            "mesh_resource": "",
            "mesh_file": mesh,
            "mesh_use_embedded_materials": False,
        }
        marker: Any = self.store.types["visualization_msgs/msg/Marker"]
        return marker(**values)


@lru_cache(maxsize=1)
def _typestore() -> Typestore:
    """The types of ROS 2 Humble, and vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from objslam.sources.ros.layouts import VISION_MSGS_3D

    store = get_typestore(Stores.ROS2_HUMBLE)
    known = get_types_from_msg(VISION_MSGS_3D, "vision_msgs/msg/Detection3DArray")
    store.register({name: fields for name, fields in known.items() if name not in store.fielddefs})
    return store
