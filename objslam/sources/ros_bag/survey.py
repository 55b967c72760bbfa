"""Read a recording once. Keep the times of every topic, and the messages that objslam may use.

All poses, transforms and boxes are kept, because they are small. Only two different calibrations and the first image of a
topic are kept.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from objslam.core.arrays import Floats, Ints
from objslam.io.box_collector import BoxCollector
from objslam.ros.bag.recording import Recording, read_messages
from objslam.ros.bag.records import MAX_NAME, Connection, FileReport, frame_name
from objslam.ros.message_limits import check_size
from objslam.ros.messages.decode import DecodeError, make_decoder, read_head
from objslam.ros.messages.detections import WRONG_LAYOUT, find_boxes, track_number
from objslam.ros.messages.poses import PoseRows, choose_times
from objslam.ros.messages.topic_types import CAMERA_INFO, COMPRESSED, IMAGE, ODOMETRY, POSES, TRANSFORMS, is_boxes
from objslam.ros.tf.tree import TfRows
from objslam.ros.topics import namespace

_MAX_TOPICS = 10_000  # The most topics that are read. Messages of other topics count as damage. More topics: more memory.
_Decoder = Callable[[bytes], Any]
_Handler = Callable[[bytes, int], None]


@dataclass
class Topic:
    """The content of a topic.

    logged: the times of recording, ns. stamps: the header stamps, ns. They are empty for tf and for types that objslam does
    not use. frames: the number of messages with each frame_id. refused: the number of unusable messages for each reason.
    poses: the poses by (frame, child frame). tracks: the track id of each track whose name is no number. points: maps the
    index in `boxes` of each tag without a box to its centre and corners (5, 3), m. infos: up to two different CameraInfo
    messages, by their bytes without the stamp. image: the first image, decoded.
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
        """The name of the topic."""
        return self.connection.topic

    @property
    def type(self) -> str:
        """The type of the messages."""
        return self.connection.type

    @property
    def frame(self) -> str:
        """The most frequent frame_id, without a leading slash. It is "" if no message has one."""
        return frame_name(max(self.frames, key=lambda frame: self.frames[frame], default=""))

    def times(self) -> Ints:
        """Return the header stamps (N,), ns, or the times of recording if all header stamps are missing or zero."""
        return choose_times(self.stamps, self.logged)


@dataclass(frozen=True)
class Survey:
    """The content of a recording. topics: the topics by name. tf: the transforms of the tf topics by namespace. reports: a
    report on each file."""

    recording: Recording
    topics: dict[str, Topic]
    tf: dict[str, TfRows]
    reports: tuple[FileReport, ...]

    def damage(self) -> tuple[str, ...]:
        """Return one line for each kind of damage in each file."""
        return tuple(line for report in self.reports for line in report.lines())


def take_survey(recording: Recording, label: str) -> Survey:
    """Read a recording once, and return its content. label: the label of boxes without a class.

    The reports count damage, and the topics count unusable messages. Raises LogError if no file can be read.
    """
    topics: dict[str, Topic] = {}
    tf: dict[str, TfRows] = {}
    handlers: dict[int, tuple[Connection, Topic, _Handler]] = {}
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
        except DecodeError as error:
            topic.refused[str(error)] += 1
    return Survey(recording, topics, tf, tuple(reports))


def _make_handler(connection: Connection, topic: Topic, tf: dict[str, TfRows], label: str) -> _Handler:
    kind = connection.type
    makers = {ODOMETRY: _add_pose, CAMERA_INFO: _add_info, IMAGE: _add_image, COMPRESSED: _add_image}
    makers |= dict.fromkeys(POSES, _add_pose)
    if not (kind in makers or kind in TRANSFORMS or is_boxes(kind)):
        return lambda data, logged: None
    if kind != topic.type:
        return partial(_refuse, f"the type is {kind}, but the topic's first type is {topic.type}")
    try:
        decode = make_decoder(connection)
    except DecodeError as error:
        return partial(_refuse, str(error))
    if kind in TRANSFORMS:
        return partial(_add_transforms, connection, decode, tf.setdefault(namespace(connection.topic), TfRows()))
    if is_boxes(kind):
        return partial(_add_boxes, connection, topic, decode, label)
    return partial(makers[kind], connection, topic, decode)


def _refuse(reason: str, data: bytes, logged: int) -> None:
    raise DecodeError(reason)


def _note_header(connection: Connection, topic: Topic, data: bytes) -> None:
    stamp, frame, _ = read_head(data, connection.encoding)
    topic.stamps.append(stamp)
    topic.frames[frame[:MAX_NAME]] += 1


def _add_pose(connection: Connection, topic: Topic, decode: _Decoder, data: bytes, logged: int) -> None:
    _note_header(connection, topic, data)
    message = decode(data)
    child = message.child_frame_id if connection.type == ODOMETRY else ""
    names = frame_name(message.header.frame_id[:MAX_NAME]), frame_name(child[:MAX_NAME])
    rows = topic.poses.get(names)
    if rows is None:
        rows = topic.poses[names] = PoseRows()
    pose = message.pose if connection.type == POSES[0] else message.pose.pose
    rows.add(topic.stamps[-1], logged, pose.position, pose.orientation)


def _add_transforms(connection: Connection, decode: _Decoder, tf: TfRows, data: bytes, logged: int) -> None:
    check_size(connection.type, data, connection.encoding)
    for transform in decode(data).transforms:
        tf.add(transform, logged, connection.topic.endswith("tf_static"))


def _add_info(connection: Connection, topic: Topic, decode: _Decoder, data: bytes, logged: int) -> None:
    _note_header(connection, topic, data)
    body = data[12:]  # The message without its stamp: the frame_id and the calibration.
    if body not in topic.infos:
        info = decode(data)
        if len(topic.infos) < 2:
            topic.infos[body] = info


def _add_image(connection: Connection, topic: Topic, decode: _Decoder, data: bytes, logged: int) -> None:
    _note_header(connection, topic, data)
    if topic.image is None:
        topic.image = decode(data)


def _add_boxes(connection: Connection, topic: Topic, decode: _Decoder, label: str, data: bytes, logged: int) -> None:
    check_size(connection.type, data, connection.encoding)
    try:
        found = list(find_boxes(connection.type, decode(data)))
    except WRONG_LAYOUT as error:
        raise DecodeError(f"the fields do not fit detections ({error})") from error
    _note_header(connection, topic, data)
    place = f"{topic.name} at {logged / 1e9:.3f} s"
    topic.boxes.add_frame(logged / 1e9, place)
    for box, name, score, track, points, corners in found:
        if points is not None:
            topic.points[len(topic.boxes.boxes)] = points
        track_id = track_number(track, topic.tracks)
        topic.boxes.add_box(box, name or label, score, place, track_id=track_id, corners=corners)
