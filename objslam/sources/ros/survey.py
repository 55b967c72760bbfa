"""One pass over a recording: every topic with its times, and what the topics that may matter hold.

Poses, transforms, boxes and calibrations are kept, being small; of images only their times.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from objslam.sources.boxes import BoxCollector
from objslam.sources.ros.boxes2d import MAX_BOXES, Found, tag_boxes, vision_boxes
from objslam.sources.ros.decode import Undecodable, make_decoder, read_head, read_length
from objslam.sources.ros.recording import Recording, read_messages
from objslam.sources.ros.records import MAX_NAME, Connection, FileReport, frame_name
from objslam.sources.ros.rows import PoseRows, choose_times
from objslam.sources.ros.tf_tree import MAX_TRANSFORMS, TfRows
from objslam.types import Floats, Ints

ODOMETRY, IMAGE, COMPRESSED = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
CAMERA_INFO, DETECTIONS = "sensor_msgs/msg/CameraInfo", "vision_msgs/msg/Detection2DArray"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_MAX_SMALL = 64 << 20
_MAX_TOPICS = 10_000


@dataclass
class Topic:
    """What one pass learned of a topic.

    logged: times of recording, ns. stamps: the header's, ns, for the types that matter. frames: frame_ids and how often, as
    they came.
    refused: why messages could not be used, and how many. poses: by (frame, child frame). boxes: with the tracker's names
    and, by the index of the box, the points of tags that come without a box. infos: distinct CameraInfo messages. image:
    the first message, decoded.
    """

    connection: Connection
    logged: array[int] = field(default_factory=lambda: array("q"))
    stamps: array[int] = field(default_factory=lambda: array("q"))
    frames: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    poses: dict[tuple[str, str], PoseRows] = field(default_factory=dict)
    boxes: BoxCollector = field(default_factory=BoxCollector)
    tracks: dict[str, int] = field(default_factory=dict)
    points: dict[int, Floats] = field(default_factory=dict)
    infos: dict[bytes, Any] = field(default_factory=dict)
    image: Any = None

    @property
    def name(self) -> str:
        """The topic's name."""
        return self.connection.topic

    @property
    def type(self) -> str:
        """The type of its messages."""
        return self.connection.type

    @property
    def frame(self) -> str:
        """The frame_id that most messages carry, without a leading slash; "" if none does."""
        return frame_name(max(self.frames, key=lambda frame: self.frames[frame], default=""))

    def times(self) -> Ints:
        """(N,) ns: the header's stamps; the times of recording where there are none, or all are zero."""
        return choose_times(self.stamps, self.logged)


@dataclass(frozen=True)
class Survey:
    """All topics of a recording by name, its transforms, and how the reading of each file went."""

    recording: Recording
    topics: dict[str, Topic]
    tf: TfRows
    reports: tuple[FileReport, ...]


def take_survey(recording: Recording, *, label: str = "") -> Survey:
    """Read a recording once. label: for boxes that come without a class.

    LogError where no file of it can be read. What else cannot be read or used is counted in the reports and topics.
    """
    topics: dict[str, Topic] = {}
    tf = TfRows()
    handlers: dict[int, tuple[Connection, Topic, Callable[[bytes, int], None]]] = {}
    reports: list[FileReport] = []
    for connection, logged, data in read_messages(recording, lambda connection: True, reports):
        entry = handlers.get(id(connection))
        if entry is None:
            if len(topics) >= _MAX_TOPICS and connection.topic not in topics:
                reports[-1].damage(f"messages of topics beyond the first {_MAX_TOPICS}", 1)
                continue
            topic = topics.setdefault(connection.topic, Topic(connection))
            entry = handlers[id(connection)] = connection, topic, _make_handler(connection, topic, tf, label)
        _, topic, handle = entry
        topic.logged.append(logged)
        try:
            handle(data, logged)
        except Undecodable as error:
            topic.refused[str(error)] += 1
    return Survey(recording, topics, tf, tuple(reports))


def is_tags(type_: str) -> bool:
    """Whether a type is an array of AprilTag detections, of whatever package."""
    package, _, name = type_.partition("/msg/")
    return "apriltag" in package and name.endswith(("Array", "ArrayStamped"))


def _make_handler(connection: Connection, topic: Topic, tf: TfRows, label: str) -> Callable[[bytes, int], None]:
    """What is done with each message of a connection."""
    kind = connection.type
    makers = {ODOMETRY: _poses, CAMERA_INFO: _infos, IMAGE: _images, COMPRESSED: _images} | dict.fromkeys(POSES, _poses)
    known = kind in makers or kind in TF or kind == DETECTIONS or is_tags(kind)
    if not known:
        return lambda data, logged: None
    if kind != topic.type:
        return _refuse(f"of type {kind}, the topic's first was {topic.type}")
    try:
        decode = make_decoder(connection)
    except Undecodable as error:
        return _refuse(str(error))
    if kind in TF:
        return _transforms(connection, decode, tf)
    if kind == DETECTIONS or is_tags(kind):
        return _boxes(connection, topic, decode, label)
    return makers[kind](connection, topic, decode)


def _refuse(reason: str) -> Callable[[bytes, int], None]:
    def handle(data: bytes, logged: int) -> None:
        raise Undecodable(reason)

    return handle


def _stamped(connection: Connection, topic: Topic, data: bytes) -> int:
    """Note the header of a message; the number behind it is returned."""
    stamp, frame, number = read_head(data, connection.encoding)
    topic.stamps.append(stamp)
    topic.frames[frame[:MAX_NAME]] += 1
    return number


def _poses(connection: Connection, topic: Topic, decode: Callable[[bytes], Any]) -> Callable[[bytes, int], None]:
    odometry, covariance = connection.type == ODOMETRY, connection.type != POSES[0]
    rows_of: dict[tuple[str, str], PoseRows] = {}  # by the names as they came, which are a few

    def handle(data: bytes, logged: int) -> None:
        _stamped(connection, topic, data)
        message = decode(data)
        names = message.header.frame_id[:MAX_NAME], message.child_frame_id[:MAX_NAME] if odometry else ""
        rows = rows_of.get(names)
        if rows is None:
            rows = rows_of[names] = topic.poses.setdefault((frame_name(names[0]), frame_name(names[1])), PoseRows())
        pose = message.pose.pose if covariance else message.pose
        rows.add(topic.stamps[-1], logged, pose.position, pose.orientation)

    return handle


def _transforms(connection: Connection, decode: Callable[[bytes], Any], tf: TfRows) -> Callable[[bytes, int], None]:
    static = connection.topic.endswith("tf_static")

    def handle(data: bytes, logged: int) -> None:
        if read_length(data, connection.encoding) > MAX_TRANSFORMS:
            raise Undecodable(f"more than {MAX_TRANSFORMS} transforms in one message")
        for transform in decode(data).transforms:
            tf.add(transform, logged, static)

    return handle


def _infos(connection: Connection, topic: Topic, decode: Callable[[bytes], Any]) -> Callable[[bytes, int], None]:
    def handle(data: bytes, logged: int) -> None:
        _stamped(connection, topic, data)
        body = data[12:]  # all but the stamp: the calibration, and the frame it is for
        if body not in topic.infos:
            info = decode(data)
            if len(topic.infos) < 2:
                topic.infos[body] = info

    return handle


def _images(connection: Connection, topic: Topic, decode: Callable[[bytes], Any]) -> Callable[[bytes, int], None]:
    def handle(data: bytes, logged: int) -> None:
        _stamped(connection, topic, data)
        if topic.image is None:
            topic.image = decode(data)

    return handle


def _boxes(connection: Connection, topic: Topic, decode: Callable[[bytes], Any], label: str) -> Callable[[bytes, int], None]:
    find: Callable[[Any], Iterator[Found]] = vision_boxes if connection.type == DETECTIONS else tag_boxes
    boxes = topic.boxes

    def handle(data: bytes, logged: int) -> None:
        stamp, frame, number = read_head(data, connection.encoding)
        if number > MAX_BOXES:
            raise Undecodable(f"more than {MAX_BOXES} detections in one message")
        if len(data) > _MAX_SMALL:
            raise Undecodable(f"a message of more than {_MAX_SMALL >> 20} MiB")
        try:
            found = list(find(decode(data)))
        except (AttributeError, TypeError, LookupError, ValueError) as error:
            raise Undecodable(f"not laid out as detections are ({error})") from error
        topic.stamps.append(stamp)
        topic.frames[frame[:MAX_NAME]] += 1
        place = f"{topic.name} at {logged / 1e9:.3f} s"
        boxes.add_frame(logged / 1e9, place)
        for box, name, score, track, points in found:
            if points is not None:
                topic.points[len(boxes.boxes)] = points
            boxes.add_box(box, name or label, score, place, track_id=track_number(track, topic.tracks))

    return handle


def track_number(name: str, tracks: dict[str, int]) -> int:
    """A tracker's name for an object as a number: -1 for none, its own number if it is one, else a new one for each name."""
    if not name:
        return -1
    if name.isascii() and name.isdigit() and len(name) < 18:
        return int(name)
    return tracks.setdefault(name, 10**18 + len(tracks))
