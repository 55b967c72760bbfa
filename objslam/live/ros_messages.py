"""ROS messages become pushes: odometry, transforms, calibrations, boxes, images, whatever middleware brought them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from objslam.errors import ConfigError
from objslam.ledger import Ledger
from objslam.live.frames import Boxes
from objslam.live.interface import Sink
from objslam.live.ros_cameras import Cameras
from objslam.live.tf_buffer import TfBuffer, Unknown
from objslam.sources.camera_file import Calibration
from objslam.sources.ros.boxes2d import MAX_BOXES, tag_boxes, vision_boxes
from objslam.sources.ros.paths import BASES, ODOM, is_world
from objslam.sources.ros.records import frame_name, plain
from objslam.sources.ros.roles import NONE, ROLES, TF
from objslam.sources.ros.rows import one_pose
from objslam.sources.ros.survey import CAMERA_INFO, COMPRESSED, DETECTIONS, IMAGE, ODOMETRY, POSES, is_tags, track_number
from objslam.sources.ros.survey import TF as TF_TYPES
from objslam.types import Floats

if TYPE_CHECKING:
    from objslam.live.detector_worker import DetectorWorker

_GRACE = 2.0  # s that tf waits before it stands in for an odometry topic
_STILL = 1e-9
_LONGEST = 160  # letters of a place
_MAX_TRACKS = 100_000
_WRONG = (AttributeError, TypeError, LookupError, ValueError)

LIVE_ROLES = (*ROLES, "tf", "tf_static")

Choices = Mapping[str, Sequence[str]]
"""By role, the topics that a user chose for it; "tf" for the transforms, "none" for no topic."""


@dataclass(frozen=True)
class RosOptions:
    """What messages do not say themselves.

    topics: choices by role. base_frame: the frame that is base. calibrations: in place of CameraInfo. rectified: whether
    boxes are in the pixels of the rectified image, None to tell by the topic's name. label: for boxes without a class.
    """

    topics: Choices = field(default_factory=dict)
    base_frame: str | None = None
    calibrations: tuple[Calibration, ...] = ()
    rectified: bool | None = None
    label: str = ""


def parse_topics(texts: Sequence[str]) -> Choices:
    """Choices from "role=/name"; ConfigError where there is no such role, or tf cannot play it."""
    choices: dict[str, list[str]] = {}
    for text in texts:
        role, sign, name = (part.strip() for part in text.partition("="))
        if not sign or not name or role not in LIVE_ROLES:
            raise ConfigError(f"--topic {text!r} is not role=/name", hint=f"roles: {', '.join(LIVE_ROLES)}")
        if name == TF and role not in ("odometry", "localization"):
            raise ConfigError(f"--topic {text}: tf gives odometry and localization only")
        word = name in (TF, NONE)
        choices.setdefault(role, []).append(name if word or name.startswith("/") else f"/{name}")
    return choices


class RosMessages:
    """Takes messages of ROS 1 or 2 by type and pushes what they say into a sink; callable from any thread.

    Odometry comes from one topic, else from tf; localisation from tf (each new map -> odom, with the odometry that follows
    it), or from poses in map. What cannot be used is counted in `ledger`.
    """

    def __init__(
        self,
        sink: Sink,
        options: RosOptions | None = None,
        detector: DetectorWorker | None = None,
        clock: Callable[[], float] = time.monotonic,
        ledger: Ledger | None = None,
    ) -> None:
        self.ledger = ledger if ledger is not None else Ledger()
        self._sink, self._options, self._detector, self._clock = sink, options or RosOptions(), detector, clock
        self._lock = threading.RLock()
        self._tf = TfBuffer()
        self._cameras = Cameras(sink, self._tf, self._base, self._drop, self._options.calibrations, self._options.rectified)
        self._sources = {role: names[0] for role, names in self._options.topics.items() if len(names) == 1}
        self._child = ""
        self._odom = ""
        self._correction: Floats | None = None
        self._corrected = False
        self._tf_since: float | None = None
        self._tf_stamp: float | None = None
        self._tracks: dict[str, int] = {}
        if detector is not None:
            detector.start(self.add_boxes, self._drop)

    def receive(self, type_: str, topic: str, message: Any, received: float) -> None:
        """Take a message. type_: as ROS 2 writes it (nav_msgs/msg/Odometry). received: s since 1970, for unset stamps."""
        with self._lock:
            if type_ == ODOMETRY:
                self._take_odometry(topic, message, received)
            elif type_ in POSES:
                self._take_pose(topic, message, received)
            elif type_ in TF_TYPES:
                self._take_transforms(topic, message, received)
            elif type_ == DETECTIONS or is_tags(type_):
                self._take_boxes(type_, topic, message, received)
            elif type_ == CAMERA_INFO:
                self._cameras.add_info(topic, message)
                self._cameras.settle(self._clock())
            elif type_ in (IMAGE, COMPRESSED) and topic in self._options.topics.get("depth", ()):
                self._cameras.add_depth(topic, message, _stamp(message.header, received))
                self._cameras.settle(self._clock())
            elif type_ in (IMAGE, COMPRESSED) and self._detector is not None:
                self._detector.offer(topic, message, _stamp(message.header, received))

    def refuse(self, reason: str, where: str, count: int = 1) -> None:
        """Count messages that never became objects."""
        self._drop(reason, where, count)

    def tick(self) -> None:
        """To be called some times a second: gives up on what has waited too long."""
        with self._lock:
            self._cameras.settle(self._clock())

    def add_boxes(self, boxes: Boxes) -> None:
        """Push the boxes of an image, however they were found."""
        with self._lock:
            self._cameras.add(boxes)

    def image(self, camera: str, stamp: float) -> NDArray[np.uint8] | None:
        """The image (H, W, 3), uint8 BGR, that the detector saw at a stamp, s; None where it is not one of the newest."""
        with self._lock:
            return self._cameras.image(camera, stamp)

    def serves(self, role: str) -> str | None:
        """The topic (or "tf") that plays a role by now."""
        return self._sources.get(role)

    def _drop(self, reason: str, where: str = "", count: int = 1) -> None:
        with self._lock:
            self.ledger.drop(reason, count, where[:_LONGEST] or None)

    def _takes(self, role: str, source: str) -> bool:
        """Whether a source plays a role: the one that was chosen, else the first that came."""
        if self._sources.setdefault(role, source) == source:
            return True
        if source != TF:
            self._drop(f"{role} from another topic than the one taken", source)
        return False

    def _base(self) -> str:
        """The frame that is base: the one given, else what the odometry moves, else base_footprint or base_link."""
        if self._options.base_frame is not None:
            return self._options.base_frame.lstrip("/")
        frames = self._tf.frames
        if self._child and self._child in frames:
            return self._child
        named = sorted(
            (frame for frame in frames if frame.rpartition("/")[2] in BASES),
            key=lambda frame: (BASES.index(frame.rpartition("/")[2]), frame),
        )
        return named[0] if named else self._child or BASES[-1]

    def _take_odometry(self, topic: str, message: Any, received: float) -> None:
        frame, child = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
        stamp, pose = _stamp(message.header, received), one_pose(message.pose.pose.position, message.pose.pose.orientation)
        covariance = _covariance(message.pose.covariance)
        role = "localization" if is_world(frame) or topic in self._options.topics.get("localization", ()) else "odometry"
        if not self._takes(role, topic):
            return
        if pose is None:
            self._drop(f"{role} message that is no pose (not finite, or a zero quaternion)", f"{topic} at {stamp:.3f} s")
            return
        base = self._base() if child else ""
        if child and base != child and {child, base} <= self._tf.frames:
            try:
                pose, covariance = pose @ self._tf.at(child, base, stamp), None
            except Unknown as unknown:
                self._drop(f"{role} message at whose time its frame's place on the robot is not known", str(unknown))
                return
        if role == "localization":
            self._sink.push_localization(stamp, pose, covariance)
            return
        if (frame, child) != (self._odom, self._child):
            self._odom, self._child = frame, child
            with suppress(Unknown):  # no localisation by tf, so far
                self._correct(frame)
        self._push_odometry(stamp, pose, covariance)

    def _push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> None:
        self._sink.push_odometry(stamp, odom_T_base, covariance)
        if self._corrected and self._correction is not None:
            self._corrected = False
            self._sink.push_localization(stamp, self._correction @ odom_T_base)

    def _take_pose(self, topic: str, message: Any, received: float) -> None:
        if topic not in self._options.topics.get("localization", ()):  # a goal is a pose too: nothing is taken unasked
            return
        stamp, covariant = _stamp(message.header, received), hasattr(message.pose, "pose")
        place = message.pose.pose if covariant else message.pose
        pose = one_pose(place.position, place.orientation)
        if pose is None:
            self._drop("localization message that is no pose (not finite, or a zero quaternion)", topic)
            return
        self._sink.push_localization(stamp, pose, _covariance(message.pose.covariance) if covariant else None)

    def _take_transforms(self, topic: str, message: Any, received: float) -> None:
        static = topic.endswith("tf_static")
        changed: set[str] = set()
        for transform in message.transforms:
            try:
                changed.add(self._tf.add(transform, received, static))
            except ValueError as error:
                frames = f"{transform.header.frame_id} -> {transform.child_frame_id}"
                self._drop(str(error), f"{topic}: {plain(frames)}")
        with suppress(Unknown):  # the tree is not whole yet: the boxes that wait for what is missing will say so
            self._read_path(changed)
        self._cameras.settle(self._clock())

    def _read_path(self, changed: set[str]) -> None:
        """Odometry and localisation out of the transforms that have just changed."""
        base = self._base()
        above = self._tf.above(base)
        odom = self._odom or next((frame for frame in above if frame.rpartition("/")[2] == ODOM), "")
        if odom:
            if any(frame in changed for frame in self._tf.above(odom)):
                self._correct(odom)
            if odom in above[1:] and self._odometry_by_tf():
                stamp = self._news(odom, base)
                if stamp is not None and self._takes("odometry", TF):
                    self._push_odometry(stamp, self._tf.at(odom, base, stamp))
            return
        world = next((frame for frame in above[1:] if is_world(frame)), "")
        stamp = self._news(world, base) if world else None
        if stamp is not None and self._takes("localization", TF):
            self._sink.push_localization(stamp, self._tf.at(world, base, stamp))

    def _news(self, top: str, base: str) -> float | None:
        """The newest stamp at which top_T_base is known, None where it is the same as last time, or all is static."""
        stamp = self._tf.newest(top, base)
        news = None if stamp == self._tf_stamp else stamp
        self._tf_stamp = stamp
        return news

    def _correct(self, odom: str) -> None:
        """A new map -> odom: it is pushed with the odometry that comes next. One that is only repeated tells nothing new."""
        world = next((frame for frame in self._tf.above(odom)[1:] if is_world(frame)), "")
        if not world or not self._takes("localization", TF):
            return
        correction = self._tf.at(world, odom, self._tf.newest(world, odom) or 0.0)
        if self._correction is None or np.abs(correction - self._correction).max() > _STILL:
            self._correction, self._corrected = correction, True

    def _odometry_by_tf(self) -> bool:
        """Whether tf gives the odometry: where a user says so, or no topic has come up for a while."""
        if "odometry" in self._sources:
            return self._sources["odometry"] == TF
        now = self._clock()
        self._tf_since = now if self._tf_since is None else self._tf_since
        return now - self._tf_since > _GRACE

    def _take_boxes(self, type_: str, topic: str, message: Any, received: float) -> None:
        stamp = _stamp(message.header, received)
        try:
            found = list((vision_boxes if type_ == DETECTIONS else tag_boxes)(message))
            rows = np.array([box for box, *_ in found], dtype=np.float64).reshape(-1, 4)
            scores = np.array([score for _, _, score, _, _ in found], dtype=np.float64)
        except _WRONG as error:
            self._drop("message not laid out as detections are", f"{topic}: {error}")
            return
        if len(found) > MAX_BOXES:
            self._drop(f"message with more than {MAX_BOXES} detections", topic)
            return
        frame = message.header.frame_id
        if not frame and found:  # some detectors fill in the header of each box alone
            frame = getattr(getattr(next(iter(getattr(message, "detections", ())), None), "header", None), "frame_id", "")
        labels = [label or self._options.label for _, label, _, _, _ in found]
        if len(self._tracks) > _MAX_TRACKS:  # a tracker that never repeats a name says nothing by them
            self._tracks.clear()
        tracks = [track_number(track, self._tracks) for _, _, _, track, _ in found]
        points = {index: place for index, (*_, place) in enumerate(found) if place is not None}
        known = tracks if any(track >= 0 for track in tracks) else None
        place = topic, stamp, frame_name(frame), self._clock()
        self._cameras.add(Boxes(*place, rows, labels, scores, known, points, whole=is_tags(type_)))


def _stamp(header: Any, received: float) -> float:
    return float(header.stamp.sec + header.stamp.nanosec * 1e-9) or received


def _covariance(values: Any) -> Floats | None:
    """(6, 6), None where nobody has filled it in."""
    matrix = np.array(values, dtype=np.float64)
    return matrix.reshape(6, 6) if matrix.size == 36 and np.isfinite(matrix).all() and matrix.any() else None
