"""A session's map out again over DDS, for RViz and Nav2: objects, markers and the corrected path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.geometry import quaternion
from objslam.live.dds_network import Network
from objslam.live.dds_types import dds_topic, layouts_of, pack
from objslam.live.interface import Snapshot
from objslam.scene import ellipsoid, label_colours
from objslam.sources.ros.decode import typestores
from objslam.types import Floats, MapObject

if TYPE_CHECKING:
    from collections.abc import Callable

OBJECTS, MARKERS, PATH = "vision_msgs/msg/Detection3DArray", "visualization_msgs/msg/MarkerArray", "nav_msgs/msg/Path"
TOPICS = {"objects": OBJECTS, "markers": MARKERS, "path": PATH}
"""What is published below the prefix, and its type."""

_MAX_PATH = 500  # poses: a path of hours is thinned out, so that showing it never takes time from making it
_SPHERE, _TEXT, _ADD, _DELETE_ALL = 2, 9, 0, 3
_SMALL, _LETTERS, _ABOVE = 0.15, 0.15, 0.15  # m: an object of unknown size, text, and how far that floats above


class DdsPublisher:
    """Publishes snapshots below a prefix; each keeps its last message for those who come later (transient-local).

    Objects without a position to rely on are left out. `publish` is to be called from one thread.
    """

    def __init__(self, network: Network, prefix: str = "/objslam") -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        # a subscriber that stands still must not hold up the session: no waiting for it, and the last message alone counts
        qos = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
        self.topics = {name: f"{prefix.rstrip('/')}/{name}" for name in TOPICS}
        self._writers: dict[str, Any] = {
            name: DataWriter(
                network.participant, Topic(network.participant, dds_topic(self.topics[name]), layouts_of(type_)[0]), qos=qos
            )
            for name, type_ in TOPICS.items()
        }

    def publish(self, snapshot: Snapshot) -> None:
        """Send a snapshot's objects, markers and path."""
        for name, make in (("objects", objects_message), ("markers", markers_message), ("path", path_message)):
            self._writers[name].write(pack(TOPICS[name], make(snapshot)))


def objects_message(snapshot: Snapshot) -> Any:
    """The resolved objects as a vision_msgs/Detection3DArray: label, how likely there is such an object, place, size."""
    make = _maker(OBJECTS)
    header = _header(make, snapshot)
    detections = []
    for o in snapshot.map.resolved():
        pose = make("geometry_msgs/Pose", _point(make, o.position), _turn(make, np.eye(3)))
        covariance = np.zeros((6, 6))
        if o.covariance is not None:
            covariance[:3, :3] = o.covariance
        hypothesis = make("vision_msgs/ObjectHypothesis", o.label, 1.0 if o.existence is None else float(o.existence))
        placed = make("geometry_msgs/PoseWithCovariance", pose, covariance.ravel())
        result = make("vision_msgs/ObjectHypothesisWithPose", hypothesis, placed)
        width, height = o.extent or (0.0, 0.0)
        box = make(
            "vision_msgs/BoundingBox3D", pose, make("geometry_msgs/Vector3", float(width), float(width), float(height))
        )
        detections.append(make("vision_msgs/Detection3D", header, [result], box, str(o.id)))
    return make("vision_msgs/Detection3DArray", header, detections)


def markers_message(snapshot: Snapshot) -> Any:
    """The resolved objects as a visualization_msgs/MarkerArray: a body, its 2-sigma ellipsoid, its label.

    The first marker takes away all that were shown before.
    """
    make = _maker(MARKERS)
    header, colours = _header(make, snapshot), label_colours(snapshot.map)
    markers = [
        _marker(make, header, "", 0, _SPHERE, np.zeros(3), np.eye(3), np.zeros(3), (0.0, 0.0, 0.0), action=_DELETE_ALL)
    ]
    for o in snapshot.map.resolved():
        colour, size = colours[o.label], _size(o)
        markers.append(_marker(make, header, "objects", o.id, _SPHERE, o.position, np.eye(3), size, colour))
        spread = ellipsoid(o)
        if spread is not None:
            axes, turn = spread
            markers.append(
                _marker(make, header, "uncertainty", o.id, _SPHERE, o.position, turn, 2 * axes, colour, alpha=0.25)
            )
        above = o.position + np.array([0.0, 0.0, size[2] / 2 + _ABOVE])
        letters = np.array([0.0, 0.0, _LETTERS])
        markers.append(
            _marker(make, header, "labels", o.id, _TEXT, above, np.eye(3), letters, (1.0, 1.0, 1.0), text=o.label)
        )
    return make("visualization_msgs/MarkerArray", markers)


def path_message(snapshot: Snapshot) -> Any:
    """The corrected path as a nav_msgs/Path, thinned out to a bounded length; the newest pose is always there."""
    make = _maker(PATH)
    stamps, poses = snapshot.path.stamps, snapshot.path.poses
    step = max(1, math.ceil(len(stamps) / _MAX_PATH))
    chosen = np.arange(len(stamps) - 1, -1, -step)[::-1]
    turns = quaternion(poses[chosen]) if len(chosen) else np.zeros((0, 4))
    placed = []
    for index, turn in zip(chosen.tolist(), turns.tolist(), strict=True):
        pose = make("geometry_msgs/Pose", _point(make, poses[index, :3, 3]), make("geometry_msgs/Quaternion", *turn))
        placed.append(make("geometry_msgs/PoseStamped", _header(make, snapshot, float(stamps[index])), pose))
    return make("nav_msgs/Path", _header(make, snapshot), placed)


def _maker(type_: str) -> Callable[..., Any]:
    """What makes the messages that a type is made of, from package/Name and the fields in their order."""
    types = typestores(type_, "cdr", "", "msg")[0].types
    return lambda name, *fields: types[name.replace("/", "/msg/")](*fields)


def _header(make: Callable[..., Any], snapshot: Snapshot, stamp: float | None = None) -> Any:
    time = snapshot.stamp if stamp is None else stamp
    nanoseconds = round(time * 1e9) if math.isfinite(time) else 0
    stamped = make("builtin_interfaces/Time", nanoseconds // 10**9, nanoseconds % 10**9)
    return make("std_msgs/Header", stamped, snapshot.map.frame)


def _point(make: Callable[..., Any], place: Floats) -> Any:
    return make("geometry_msgs/Point", *(float(v) for v in place))


def _turn(make: Callable[..., Any], rotation: Floats) -> Any:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return make("geometry_msgs/Quaternion", *quaternion(pose[None])[0].tolist())


def _size(o: MapObject) -> Floats:
    width, height = o.extent or (_SMALL, _SMALL)
    return np.array([width, width, height])


def _marker(
    make: Callable[..., Any],
    header: Any,
    namespace: str,
    number: int,
    shape: int,
    place: Floats,
    turn: Floats,
    scale: Floats,
    colour: tuple[float, float, float],
    *,
    action: int = _ADD,
    alpha: float = 1.0,
    text: str = "",
) -> Any:
    pose = make("geometry_msgs/Pose", _point(make, place), _turn(make, turn))
    size = make("geometry_msgs/Vector3", *(float(v) for v in scale))
    paint = make("std_msgs/ColorRGBA", *colour, alpha)
    forever = make("builtin_interfaces/Duration", 0, 0)
    nothing = np.zeros(0, dtype=np.uint8)
    texture = make("sensor_msgs/CompressedImage", header, "", nothing)
    mesh = make("visualization_msgs/MeshFile", "", nothing)
    body: tuple[Any, ...] = (header, namespace, number, shape, action, pose, size, paint, forever, False, [], [])
    return make("visualization_msgs/Marker", *body, "", texture, [], text, "", mesh, False)
