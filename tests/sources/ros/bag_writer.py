"""Bags for tests: messages made by hand and written by the libraries' own writers, ROS 1, sqlite3 and MCAP.

A row is (topic, time of recording in ns, message). Layouts of packages that the type library lacks are spelt out here, on
their own account.
"""

import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

_HYPOTHESES = {
    "1": "int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "2": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "3": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
}
_DETECTION = "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
_DETECTIONS = {
    "1": _DETECTION + "sensor_msgs/Image source_img\n",
    "2": _DETECTION + "sensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id\n",
    "3": _DETECTION + "string id\n",
}
_BOXES = {"3": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"}
_BOXES |= {"1": _BOXES["3"], "2": _BOXES["3"], "4": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"}
_ARRAY = "std_msgs/Header header\n{}[] {}\n"
_APRILTAGS = {
    "apriltag_msgs/msg/AprilTagDetectionArray": _ARRAY.format("apriltag_msgs/AprilTagDetection", "detections"),
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nint32 hamming\n"
    "float32 goodness\nfloat32 decision_margin\napriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\n"
    "float64[9] homography\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_ros/msg/AprilTagDetectionArray": _ARRAY.format("apriltag_ros/AprilTagDetection", "detections"),
    "apriltag_ros/msg/AprilTagDetection": "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n",
}


class Maker:
    """Makes messages of ROS 1 or 2, with vision_msgs of one of its layouts ("1", "2", "3" or "4")."""

    def __init__(self, vision: str = "4") -> None:
        self.ros1, self.vision = vision == "1", vision
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        layout = "3" if vision == "4" else vision
        texts = {
            "vision_msgs/msg/Detection2DArray": _ARRAY.format("vision_msgs/Detection2D", "detections"),
            "vision_msgs/msg/Detection2D": _DETECTIONS[layout],
            "vision_msgs/msg/ObjectHypothesisWithPose": _HYPOTHESES[layout],
            "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
            "vision_msgs/msg/BoundingBox2D": _BOXES[vision],
            "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
            "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
            "geometry_msgs/msg/Pose2D": "float64 x\nfloat64 y\nfloat64 theta\n",
            "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
            **_APRILTAGS,
        }
        types = {}
        for name, text in texts.items():
            types.update(get_types_from_msg(text, name))
        self.store.register(types)

    def make(self, name, *args):
        """A message by its type (package/Name) and its fields in order."""
        return self.store.types[name.replace("/", "/msg/")](*args)

    def header(self, stamp, frame=""):
        """stamp: ns."""
        time = self.make("builtin_interfaces/Time", stamp // 10**9, stamp % 10**9)
        return self.make("std_msgs/Header", *([0] if self.ros1 else []), time, frame)

    def pose(self, pose):
        x, y, z = (float(v) for v in pose[:3, 3])
        q = [float(v) for v in Rotation.from_matrix(pose[:3, :3]).as_quat()]
        return self.make("geometry_msgs/Pose", self.point(x, y, z), self.make("geometry_msgs/Quaternion", *q))

    def point(self, x, y, z=0.0):
        return self.make("geometry_msgs/Point", x, y, z)

    def covariant(self, pose):
        return self.make("geometry_msgs/PoseWithCovariance", self.pose(pose), np.zeros(36))

    def odometry(self, stamp, pose, frame="odom", child="base_link"):
        zero = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/TwistWithCovariance", self.make("geometry_msgs/Twist", zero, zero), np.zeros(36))
        return self.make("nav_msgs/Odometry", self.header(stamp, frame), child, self.covariant(pose), twist)

    def pose_stamped(self, stamp, pose, frame="map", covariance=True):
        if covariance:
            return self.make("geometry_msgs/PoseWithCovarianceStamped", self.header(stamp, frame), self.covariant(pose))
        return self.make("geometry_msgs/PoseStamped", self.header(stamp, frame), self.pose(pose))

    def tf(self, stamp, *transforms):
        """transforms: (parent, child, pose)."""
        made = []
        for parent, child, pose in transforms:
            plain = self.pose(pose)
            place = self.make("geometry_msgs/Vector3", *(float(v) for v in pose[:3, 3]))
            transform = self.make("geometry_msgs/Transform", place, plain.orientation)
            made.append(self.make("geometry_msgs/TransformStamped", self.header(stamp, parent), child, transform))
        return self.make("tf2_msgs/TFMessage", made)

    def camera_info(self, stamp, camera, frame, rotation=None, projection=None, binning=0, region=(0, 0, 0, 0)):
        """region: x_offset, y_offset, height, width. The message has its own arrays, so a test may spoil its numbers."""
        rotation = np.eye(3) if rotation is None else rotation
        projection = np.column_stack([camera.matrix, np.zeros(3)]) if projection is None else projection
        roi = self.make("sensor_msgs/RegionOfInterest", *region, False)
        flat = [np.array(m, dtype=np.float64).ravel() for m in (camera.matrix, rotation, projection)]
        size = camera.height, camera.width, camera.distortion_model
        numbers = np.array(camera.distortion, dtype=np.float64)
        return self.make("sensor_msgs/CameraInfo", self.header(stamp, frame), *size, numbers, *flat, binning, binning, roi)

    def image(self, stamp, array, encoding, frame="", step=0, big_endian=False):
        data = np.frombuffer(np.ascontiguousarray(array).tobytes(), dtype=np.uint8)
        height, width = array.shape[:2]
        step = step or len(data) // height
        fields = self.header(stamp, frame), height, width, encoding, int(big_endian), step, data
        return self.make("sensor_msgs/Image", *fields)

    def compressed(self, stamp, content, packing, frame=""):
        data = np.frombuffer(content, dtype=np.uint8)
        return self.make("sensor_msgs/CompressedImage", self.header(stamp, frame), packing, data)

    def detections(self, stamp, boxes, frame="camera_optical_frame"):
        """boxes: (x1, y1, x2, y2, label, score) and perhaps a track; a label of ROS 1 is a number."""
        made = []
        for x1, y1, x2, y2, label, score, *track in boxes:
            centre = float(x1 + x2) / 2, float(y1 + y2) / 2
            if self.vision == "4":
                place = self.make("vision_msgs/Pose2D", self.make("vision_msgs/Point2D", *centre), 0.0)
            else:
                place = self.make("geometry_msgs/Pose2D", *centre, 0.0)
            box = self.make("vision_msgs/BoundingBox2D", place, float(x2 - x1), float(y2 - y1))
            pose = self.covariant(np.eye(4))
            named = (int(label) if self.ros1 else str(label)), float(score)
            if self.vision in "12":
                result = self.make("vision_msgs/ObjectHypothesisWithPose", *named, pose)
                rest = [self.image(0, np.zeros((1, 1), np.uint8), "mono8")]
                rest += [bool(track), track[0] if track else ""] if self.vision == "2" else []
            else:
                hypothesis = self.make("vision_msgs/ObjectHypothesis", *named)
                result = self.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, pose)
                rest = [track[0] if track else ""]
            made.append(self.make("vision_msgs/Detection2D", self.header(stamp, frame), [result], box, *rest))
        return self.make("vision_msgs/Detection2DArray", self.header(stamp, frame), made)

    def tags(self, stamp, tags, frame="camera_optical_frame"):
        """tags: (id, corners (4, 2)) in px."""
        made = []
        for number, corners in tags:
            points = [self.make("apriltag_msgs/Point", *(float(v) for v in corner)) for corner in corners]
            args = "36h11", number, 0, 0.0, 50.0, self.make("apriltag_msgs/Point", 0.0, 0.0), points, np.zeros(9)
            made.append(self.make("apriltag_msgs/AprilTagDetection", *args))
        return self.make("apriltag_msgs/AprilTagDetectionArray", self.header(stamp, frame), made)

    def tag_poses(self, stamp, tags, frame="camera_optical_frame"):
        """tags: (ids, size, camera_T_tag)."""
        made = []
        for ids, size, pose in tags:
            stamped = self.pose_stamped(stamp, pose, frame)
            sizes = np.full(len(ids), float(size))
            made.append(self.make("apriltag_ros/AprilTagDetection", np.array(ids, dtype=np.int32), sizes, stamped))
        return self.make("apriltag_ros/AprilTagDetectionArray", self.header(stamp, frame), made)


def write_bag(path: Path, kind: str, maker: Maker, rows) -> Path:
    """Write rows as a bag of a kind: bag, bag-bz2, bag-lz4, sqlite3, sqlite3-old, sqlite3-message, sqlite3-file, mcap-none,
    mcap-lz4, mcap-zstd (of either ROS). Returns what to read: the file, or a folder for sqlite3."""
    plain, _, packing = kind.partition("-")
    if plain == "bag":
        return _write_bag1(path.with_suffix(".bag"), packing, maker, rows)
    if plain == "mcap":
        return write_mcap(path.with_suffix(".mcap"), packing, maker, rows)
    return _write_sqlite(path, packing, maker, rows)


@dataclass
class Raw:
    """A message that is bytes already."""

    data: bytes
    __msgtype__: str


def serialize(maker: Maker, message) -> bytes:
    """A message as bytes, in the encoding of the maker's ROS."""
    if isinstance(message, Raw):
        return message.data
    store = maker.store
    return bytes((store.serialize_ros1 if maker.ros1 else store.serialize_cdr)(message, message.__msgtype__))


def write_mcap(path: Path, packing: str, maker: Maker, rows, chunk_size: int = 1 << 16, finish: bool = True) -> Path:
    """An MCAP file with chunk CRCs; without `finish`, as a recorder leaves it that is killed after a chunk."""
    with path.open("wb") as file:
        compression = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}[packing]
        writer = Writer(file, chunk_size=chunk_size, compression=compression)
        version, encoding = (1, "ros1") if maker.ros1 else (2, "cdr")
        writer.start(f"ros{version}")
        channels = {}
        for topic, stamp, message in rows:
            name = message.__msgtype__
            if (topic, name) not in channels:
                text, _ = maker.store.generate_msgdef(name, ros_version=version)
                shown = name.replace("/msg/", "/") if maker.ros1 else name
                schema = writer.register_schema(shown, f"ros{version}msg", text.encode())
                channels[topic, name] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic, name], stamp, serialize(maker, message), stamp)
        if finish:
            writer.finish()
        else:
            writer.flush()
    return path


def _write_bag1(path, packing, maker, rows):
    writer = Writer1(path)
    if packing:
        writer.set_compression(Writer1.CompressionFormat[packing.upper()])
    writer.open()
    writer.chunk_threshold = 1 << 16
    connections = {}
    for topic, stamp, message in rows:
        name = message.__msgtype__
        if (topic, name) not in connections:
            connections[topic, name] = writer.add_connection(topic, name, typestore=maker.store)
        writer.write(connections[topic, name], stamp, serialize(maker, message))
    writer.close()
    return path


def _write_sqlite(folder, packing, maker, rows):
    writer = Writer2(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if packing in ("file", "message"):
        writer.set_compression(CompressionMode[packing.upper()], CompressionFormat.ZSTD)
    writer.open()
    connections = {}
    for topic, stamp, message in rows:
        name = message.__msgtype__
        if (topic, name) not in connections:
            connections[topic, name] = writer.add_connection(topic, name, typestore=maker.store)
        writer.write(connections[topic, name], stamp, serialize(maker, message))
    writer.close()
    if packing == "old":  # before ROS 2 Iron there were no definitions in the file
        database = sqlite3.connect(folder / f"{folder.name}.db3")
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
        database.commit()
        database.close()
    return folder


def copy_cut(source: Path, target: Path, share: float) -> Path:
    """The first part of a file."""
    target.write_bytes(source.read_bytes()[: int(source.stat().st_size * share)])
    return target
