"""Turns ROS messages of any middleware into pushes: odometry, transforms, calibrations, boxes and images."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.io.camera_yaml import read_calibrations, read_mounts
from objslam.live.interface import Sink
from objslam.live.ros.boxes import Boxes
from objslam.live.ros.camera_registry import Cameras
from objslam.ros.bag.records import frame_name, plain
from objslam.ros.messages.detections import MAX_BOXES, WRONG_LAYOUT, find_boxes, track_number
from objslam.ros.messages.poses import one_pose
from objslam.ros.messages.topic_types import CAMERA_INFO, IMAGES, ODOMETRY, POSES, TRANSFORMS, is_boxes, is_tags
from objslam.ros.tf.buffer import TfBuffer, UnknownTransform
from objslam.ros.tf.frames import find_base, find_odom, find_world, is_world, unchanged
from objslam.ros.topics import TF, parse_topics
from objslam.sources.ros_bag.options import RosOptions

if TYPE_CHECKING:
    from objslam.live.ros.detector_worker import DetectorWorker

_GRACE = 2.0  # The wait for an odometry topic before tf is used, s. A larger value delays robots without one.
_LONGEST = 160  # The most characters of a message's name in the ledger. A larger number makes longer lines.
_MAX_TRACKS = 100_000  # The number of track names above which all names are forgotten. A larger number costs memory.


class RosMessages:
    """Takes messages of ROS 1 or 2 by type, and pushes their content into a sink. Any thread may call the methods.

    Odometry comes from one topic, or from tf without such a topic. Localisation comes from an Odometry topic in the frame
    map, from the topics of poses that the options name, or from tf. From tf, each new transform map -> odom is pushed with
    the next odometry. If tf has no odom, the pose of base in map is pushed. ledger: the counts of unusable messages. chosen:
    the topics that the options name. sources: the topic in use, or "tf", by role.
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
        self._sink, self._detector, self._clock = sink, detector, clock
        options = self._options = options or RosOptions()
        self.chosen = parse_topics(options.topics, live=True)
        calibrations = read_calibrations(options.camera_info, self.ledger) if options.camera_info is not None else ()
        mounts = read_mounts(options.camera_info) if options.camera_info is not None else ()
        self._lock = threading.RLock()
        self._tf = TfBuffer()
        self._cameras = Cameras(sink, self._tf, self._base, self.refuse, calibrations, options.rectified, mounts)
        self.sources = {role: names[0] for (_, role), names in self.chosen.names.items() if len(names) == 1}
        self._child = self._odom = ""
        self._correction: Floats | None = None
        self._corrected = False
        self._tf_since: float | None = None
        self._tf_stamp: float | None = None
        self._tracks: dict[str, int] = {}
        if detector is not None:
            detector.start(self.add_boxes, self.refuse, self._warn)

    def receive(self, type_: str, topic: str, message: Any, received: float) -> None:
        """Take a message. type_: the type in ROS 2 form, as nav_msgs/msg/Odometry. received: s since 1970, the stamp if it
        is unset."""
        with self._lock:
            if type_ == ODOMETRY:
                self._take_odometry(topic, message, received)
            elif type_ in POSES:
                self._take_pose(topic, message, received)
            elif type_ in TRANSFORMS:
                self._take_transforms(topic, message, received)
            elif is_boxes(type_):
                self._take_boxes(type_, topic, message, received)
            elif type_ == CAMERA_INFO:
                self._cameras.add_info(topic, message)
                self.tick()
            elif type_ in IMAGES and topic in self.chosen.of("depth"):
                self._cameras.depths.add(topic, message, _stamp(message.header, received))
                self.tick()
            elif type_ in IMAGES and self._detector is not None:
                self._detector.offer(topic, message, _stamp(message.header, received))

    def refuse(self, reason: str, where: str, count: int = 1) -> None:
        """Count unusable messages. Any thread may call this."""
        with self._lock:
            self.ledger.drop(reason, count, where[:_LONGEST] or None)

    def tick(self) -> None:
        """Push or drop the boxes that wait. An adapter calls it several times a second."""
        with self._lock:
            self._cameras.settle(self._clock())

    def add_boxes(self, boxes: Boxes) -> None:
        """Push the boxes of an image, or keep them until their camera is known."""
        with self._lock:
            self._cameras.add(boxes)

    def image(self, camera: str, stamp: float) -> NDArray[np.uint8] | None:
        """Return a camera's image (H, W, 3), uint8 BGR, at a stamp, s. Return None if the image is not among the detector's
        newest images."""
        with self._lock:
            return self._cameras.image(camera, stamp)

    def odom_frame(self) -> str | None:
        """Return the frame of the odometry. Return None while it is unknown, or if it already has a parent frame in tf."""
        with self._lock, suppress(UnknownTransform):
            odom = self._odom or find_odom(self._tf.above(self._base()))
            return odom if odom and len(self._tf.above(odom)) == 1 else None
        return None

    def _warn(self, message: str) -> None:
        with self._lock:
            self.ledger.warn(message)

    def _takes(self, role: str, source: str) -> bool:
        """Return whether a source is used for a role, odometry or localization. The source that the user chose is used, else
        the first source that sends."""
        if self.sources.setdefault(role, source) == source:
            return True
        if source != TF:
            self.refuse(f"{role} from a second topic", source)
        return False

    def _base(self) -> str:
        return find_base(self._tf.likely_bases(self._child), self._options.base_frame, self._child)

    def _take_odometry(self, topic: str, message: Any, received: float) -> None:
        frame, child = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
        stamp, pose = _stamp(message.header, received), one_pose(message.pose.pose.position, message.pose.pose.orientation)
        covariance = _covariance(message.pose.covariance)
        role = "localization" if is_world(frame) or topic in self.chosen.of("localization") else "odometry"
        if not self._takes(role, topic):
            return
        if pose is None:
            fault = "message without a valid pose (not finite or a zero quaternion)"
            self.refuse(f"{role} {fault}", f"{topic} at {stamp:.3f} s")
            return
        base = self._base() if child else ""
        if child and base != child and {child, base} <= self._tf.frames:
            try:
                pose, covariance = pose @ self._tf.at(child, base, stamp), None
            except UnknownTransform as unknown:
                self.refuse(f"{role} message without a transform from its frame to the robot at that time", str(unknown))
                return
        if role == "localization":
            self._sink.push_localization(stamp, pose, covariance)
            return
        if (frame, child) != (self._odom, self._child):
            self._odom, self._child = frame, child
            with suppress(UnknownTransform):  # Perhaps tf gives no localisation yet.
                self._correct(frame)
        self._push_odometry(stamp, pose, covariance)

    def _push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> None:
        self._sink.push_odometry(stamp, odom_T_base, covariance)
        if self._corrected and self._correction is not None:
            self._corrected = False
            self._sink.push_localization(stamp, self._correction @ odom_T_base)

    def _take_pose(self, topic: str, message: Any, received: float) -> None:
        if topic not in self.chosen.of("localization"):  # A goal is a pose too, so only chosen topics are used.
            return
        stamp, covariant = _stamp(message.header, received), hasattr(message.pose, "pose")
        place = message.pose.pose if covariant else message.pose
        pose = one_pose(place.position, place.orientation)
        if pose is None:
            self.refuse("localization message without a valid pose (not finite or a zero quaternion)", topic)
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
                self.refuse(str(error), f"{topic}: {plain(frames)}")
        with suppress(UnknownTransform):  # If tf is incomplete, the waiting boxes report the missing part.
            self._read_path(changed)
        self.tick()

    def _read_path(self, changed: set[str]) -> None:
        """Push odometry and localisation from the changed transforms."""
        base = self._base()
        above = self._tf.above(base)
        odom = self._odom or find_odom(above)
        if odom:
            if any(frame in changed for frame in self._tf.above(odom)):
                self._correct(odom)
            if odom in above[1:] and self._odometry_by_tf():
                stamp = self._news(odom, base)
                if stamp is not None and self._takes("odometry", TF):
                    self._push_odometry(stamp, self._tf.at(odom, base, stamp))
            return
        world = find_world(above[1:])
        stamp = self._news(world, base) if world else None
        if stamp is not None and self._takes("localization", TF):
            self._sink.push_localization(stamp, self._tf.at(world, base, stamp))

    def _news(self, top: str, base: str) -> float | None:
        """Return the newest stamp, s, of top_T_base in tf. Return None if it has not changed, or if all transforms are
        static."""
        before, self._tf_stamp = self._tf_stamp, self._tf.newest(top, base)
        return None if self._tf_stamp == before else self._tf_stamp

    def _correct(self, odom: str) -> None:
        """Keep the transform map -> odom if it has changed. It is pushed with the next odometry."""
        world = find_world(self._tf.above(odom)[1:])
        if not world or not self._takes("localization", TF):
            return
        correction = self._tf.at(world, odom, self._tf.newest(world, odom) or 0.0)
        if self._correction is None or not unchanged(correction, self._correction):
            self._correction, self._corrected = correction, True

    def _odometry_by_tf(self) -> bool:
        """Return whether tf gives the odometry, because the user chose tf or no odometry topic has appeared for a while."""
        if "odometry" in self.sources:
            return self.sources["odometry"] == TF
        now = self._clock()
        self._tf_since = now if self._tf_since is None else self._tf_since
        return now - self._tf_since > _GRACE

    def _take_boxes(self, type_: str, topic: str, message: Any, received: float) -> None:
        stamp = _stamp(message.header, received)
        try:
            found = list(find_boxes(type_, message))
            rows = np.array([f.box for f in found], dtype=np.float64).reshape(-1, 4)
            scores = np.array([f.score for f in found], dtype=np.float64)
        except WRONG_LAYOUT as error:
            self.refuse("detection message with an unexpected layout", f"{topic}: {error}")
            return
        if len(found) > MAX_BOXES:
            self.refuse(f"message with more than {MAX_BOXES} detections", topic)
            return
        frame = message.header.frame_id
        if not frame and found:  # Some detectors fill in only the header of each box.
            frame = getattr(getattr(next(iter(getattr(message, "detections", ())), None), "header", None), "frame_id", "")
        labels = [f.label or self._options.label or "" for f in found]
        if len(self._tracks) > _MAX_TRACKS:  # A tracker that never repeats a name gives no information.
            self._tracks.clear()
        tracks = [track_number(f.track, self._tracks) for f in found]
        points = {i: f.points for i, f in enumerate(found) if f.points is not None}
        known = tracks if any(track >= 0 for track in tracks) else None
        place = topic, stamp, frame_name(frame), self._clock()
        self._cameras.add(Boxes(*place, rows, labels, scores, known, points, whole=is_tags(type_)))


def _stamp(header: Any, received: float) -> float:
    return float(header.stamp.sec + header.stamp.nanosec * 1e-9) or received


def _covariance(values: Any) -> Floats | None:
    """Return a covariance (6, 6). Return None if the message does not fill it in."""
    matrix = np.array(values, dtype=np.float64)
    return matrix.reshape(6, 6) if matrix.size == 36 and np.isfinite(matrix).all() and matrix.any() else None
