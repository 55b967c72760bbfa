"""Convert a map to ROS 2 messages (objects, markers, path), for MCAP files and for DDS. ROS is not needed.

Sources: https://docs.ros.org/en/rolling/p/vision_msgs, https://docs.ros.org/en/rolling/p/visualization_msgs.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2, make_pose, quaternion
from objslam.core.object_map import MapObject, ObjectMap
from objslam.errors import printable
from objslam.output.plot.style import DrawnShape, captions, drawn_shape, ellipsoid, label_colours

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_TEXT, _ADD, _DELETE_ALL = 9, 0, 3  # A type and actions of visualization_msgs/Marker.
_TYPES: dict[DrawnShape, int] = {"cuboid": 1, "ellipsoid": 2, "cylinder": 3}
"""The marker type of each shape: CUBE, SPHERE or CYLINDER. The three sizes of a marker may differ."""
LAST_STAMP = 2.0**31  # builtin_interfaces/Time overflows at this stamp, s.
_MIN_SIZE = 0.05  # The least diameter, m, of the marker of an object without a body. A smaller marker would be invisible.
_TEXT_SIZE = 0.15  # The height of a label's text, m.


class MapMessages:
    """A maker of messages in the frame `frame`, of types in ROS 2 Humble and later. store: serialises the messages."""

    def __init__(self, frame: str) -> None:
        self.frame, self.store = frame, typestore()

    def make(self, name: str, *values: Any) -> Any:
        """Return a message of the type `name`, written as package/Name. values: the values of its fields, in order."""
        package, _, plain = name.partition("/")
        return self.store.types[f"{package}/msg/{plain}"](*values)

    def header(self, stamp: float) -> Any:
        """Return a std_msgs/Header with a stamp, s. A stamp out of the range of ROS becomes 0, which means unset in ROS."""
        stamp = stamp if abs(stamp) < LAST_STAMP else 0.0
        time = self.make("builtin_interfaces/Time", *divmod(round(stamp * 1e9), 10**9))
        return self.make("std_msgs/Header", time, self.frame)

    def _vector(self, kind: str, values: Floats) -> Any:
        return self.make(f"geometry_msgs/{kind}", *(float(value) for value in values))

    def pose(self, pose: Floats) -> Any:
        """Make a geometry_msgs/Pose from a pose (4, 4)."""
        turn = self._vector("Quaternion", quaternion(pose[None])[0])
        return self.make("geometry_msgs/Pose", self._vector("Point", pose[:3, 3]), turn)

    def stamped(self, stamp: float, pose: Floats) -> Any:
        """Make a geometry_msgs/PoseStamped from a stamp, s, and a pose (4, 4)."""
        return self.make("geometry_msgs/PoseStamped", self.header(stamp), self.pose(pose))

    def transform(self, stamp: float, child: str, pose: Floats) -> Any:
        """Return a tf2_msgs/TFMessage with the pose (4, 4) of the frame `child` in the frame `self.frame`, at a stamp, s."""
        turn = self._vector("Quaternion", quaternion(pose[None])[0])
        transform = self.make("geometry_msgs/Transform", self._vector("Vector3", pose[:3, 3]), turn)
        stamped = self.make("geometry_msgs/TransformStamped", self.header(stamp), child, transform)
        return self.make("tf2_msgs/TFMessage", [stamped])

    def path(self, stamp: float, stamps: Floats, poses: Floats) -> Any:
        """Return a nav_msgs/Path of poses (N, 4, 4) at stamps (N,), s. stamp: the stamp of the whole message, s."""
        stamped = [self.stamped(t, pose) for t, pose in zip(stamps.tolist(), poses, strict=True)]
        return self.make("nav_msgs/Path", self.header(stamp), stamped)

    def detections(self, stamp: float, objects: tuple[MapObject, ...]) -> Any:
        """Make a vision_msgs/Detection3DArray with the labels, positions and covariances of objects.

        The score of a label is its share of the object's boxes. The 3D box is the box of the body, turned by its yaw.
        Without a body, the depth of a 3D box equals its width. A 3D box of unknown size has size 0.
        """
        return self.make("vision_msgs/Detection3DArray", self.header(stamp), [self._detection(stamp, o) for o in objects])

    def _detection(self, stamp: float, o: MapObject) -> Any:
        pose = self.pose(make_pose(np.eye(3), o.position))
        covariance = np.zeros((6, 6))
        if o.covariance is not None:
            covariance[:3, :3] = o.covariance
        with_covariance = self.make("geometry_msgs/PoseWithCovariance", pose, covariance.ravel())
        shares = {printable(label): share for label, share in (o.labels or {o.label: 1.0}).items()}
        hypotheses = [self.make("vision_msgs/ObjectHypothesis", *pair) for pair in shares.items()]
        results = [self.make("vision_msgs/ObjectHypothesisWithPose", part, with_covariance) for part in hypotheses]
        turn, size = _upright(o)
        at = self.pose(make_pose(turn, o.position))
        box = self.make("vision_msgs/BoundingBox3D", at, self._vector("Vector3", size))
        return self.make("vision_msgs/Detection3D", self.header(stamp), results, box, str(o.id))

    def markers(self, stamp: float, objects: ObjectMap, clear_first: bool = False) -> Any:
        """Return a visualization_msgs/MarkerArray: a shape, a 2-sigma ellipsoid and a caption for each resolved object.

        The shape is the `drawn_shape` of the body, with the size and yaw of the body. An object without a body is an
        ellipsoid with the size of its boxes, at least `_MIN_SIZE`. In the map of a site, the caption also has the state of
        the object.

        Args:
            clear_first: whether the first marker deletes all earlier markers.
        """
        colours, made = label_colours(objects), []
        if clear_first:
            made.append(replace(self._marker(stamp, "", 0, np.eye(4), np.zeros(3), (0.0,) * 4), action=_DELETE_ALL))
        for number, (o, name) in enumerate(zip(objects.objects, captions(objects), strict=True)):
            if o.status != "ok":
                continue
            name = name if o.life is None else f"{name}, {o.life.state}"
            colour = colours[o.label]
            turn, size = _upright(o)
            shape: DrawnShape = "ellipsoid"
            if o.body is None:
                size = np.maximum(size, _MIN_SIZE)
            else:
                shape = drawn_shape(o.body)
            at = make_pose(turn, o.position)
            above = make_pose(np.eye(3), o.position + np.array([0.0, 0.0, size[2] / 2 + _TEXT_SIZE]))
            made.append(self._marker(stamp, "objects", number, at, size, (*colour, 0.9), shape=shape))
            made.append(self._marker(stamp, "labels", number, above, np.full(3, _TEXT_SIZE), (*colour, 1.0), name))
            axes = ellipsoid(o)
            if axes is not None:
                turned = make_pose(axes[1], o.position)
                made.append(self._marker(stamp, "covariances", number, turned, 2 * axes[0], (*colour, 0.3)))
        return self.make("visualization_msgs/MarkerArray", made)

    def _marker(
        self,
        stamp: float,
        namespace: str,
        number: int,
        pose: Floats,
        size: Floats,
        colour: tuple[float, ...],
        text: str = "",
        shape: DrawnShape = "ellipsoid",
    ) -> Any:
        make, header, nothing = self.make, self.header(stamp), np.zeros(0, dtype=np.uint8)
        marker: Any = self.store.types["visualization_msgs/msg/Marker"]
        lists: dict[str, Any] = {"points": [], "colors": [], "uv_coordinates": []}
        return marker(
            header=header,
            ns=namespace,
            id=number,
            type=_TEXT if namespace == "labels" else _TYPES[shape],
            action=_ADD,
            pose=self.pose(pose),
            scale=self._vector("Vector3", np.maximum(size, 1e-3)),
            color=make("std_msgs/ColorRGBA", *(float(part) for part in colour)),
            lifetime=make("builtin_interfaces/Duration", 0, 0),
            frame_locked=False,
            texture_resource="",
            texture=make("sensor_msgs/CompressedImage", header, "", nothing),
            text=text,
            mesh_resource="",
            mesh_file=make("visualization_msgs/MeshFile", "", nothing),
            mesh_use_embedded_materials=False,
            **lists,
        )


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the message types of ROS 2 Humble and of vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from objslam.ros.messages.definitions import VISION_MSGS_3D

    store = get_typestore(Stores.ROS2_HUMBLE)
    known = get_types_from_msg(VISION_MSGS_3D, "vision_msgs/msg/Detection3DArray")
    store.register({name: fields for name, fields in known.items() if name not in store.fielddefs})
    return store


def _upright(o: MapObject) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and the size (3,), m, of the box of an object."""
    if o.body is None:
        width, height = o.extent or (0.0, 0.0)
        return np.eye(3), np.array([width, width, height])
    return lift_se2(np.array([0.0, 0.0, o.body.yaw]))[:3, :3], o.body.size
