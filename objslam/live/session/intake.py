"""The entry of a session. Every message is checked, converted to session time, delivered and counted."""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.snapshot import CAME_BEFORE, LATE_FRAME, NOT_USED
from objslam.core.validity import is_valid_position
from objslam.live.counters import Counters
from objslam.live.session import checks
from objslam.live.session.clock import Clock, Lead
from objslam.live.session.odometry_restarts import OdometryRestarts
from objslam.live.session.stamp_leaps import StampLeaps
from objslam.sources.journal.records import (
    CameraMessage,
    FrameMessage,
    Message,
    MountMessage,
    NoteMessage,
    PathKind,
    PoseMessage,
)

_MOST_CAMERAS = 256  # The most cameras of a session. A larger number costs memory if somebody makes up names.
_MOST_LABELS = 10_000  # The most labels of a session. A larger number costs memory if somebody makes up labels.
_STAMPS = 256  # The stamps per camera that are kept to detect duplicates. A larger number detects later duplicates.
_POSES = 10_000  # The poses per path that are kept to notice repeats. A larger number costs 0.3 kB of memory per pose.
_SAME_POSE = 1e-9  # Poses of one stamp that differ by less, m, are one pose. The value only allows for rounding.
_WAIT = 2.0
"""A stamp that leads the path by more than this, s, may be from before a change of the clock. Earlier shifts are then tried
for this stamp. A larger value misses more stamps from before a change."""
_AHEAD = 60.0  # The longest lead of a frame over the path, s. A larger value lets a frame with a wrong stamp wait longer.
_ALONE = "with a stamp far ahead, which the next ones did not confirm"
_KINDS = {CameraMessage: "cameras", MountMessage: "mounts", FrameMessage: "frames", NoteMessage: "notes"}


class _Checked(NamedTuple):
    """A message that was checked. push: a function that delivers it. kind, where: its kind and place in reports."""

    push: Callable[[], bool]
    kind: str
    where: str


class Intake:
    """A `Sink` that checks messages and delivers the valid ones.

    A message whose stamp leaps ahead waits until the next messages of its publisher confirm the leap (`stamp_leaps`). The
    push of such a message returns True. If the next messages refute the leap, the message is dropped and counted.

    The intake converts stamps to session time, in which the stamps of the path always increase. After a restart of the
    robot's odometry, the intake converts the new poses so that they continue the old path.

    deliver(message, arrival): a function that takes one message at a time, in the thread that pushes. It returns whether it
    accepts the message, and counts the messages that it refuses. arrival: s, by `time.perf_counter`.
    """

    def __init__(self, settings: Settings, counters: Counters, deliver: Callable[[Message, float], bool]) -> None:
        self._settings, self.counters, self._deliver = settings, counters, deliver
        self._lock = threading.Lock()
        self._clock = Clock()
        self._cameras: dict[str, Camera] = {}
        self._labels: set[str] = set()
        self._stamps: dict[str, dict[float, None]] = {}  # The last stamps of frames by camera, in the order of arrival.
        self._resumed: dict[str, float] = {}  # The stamp of the last frame of each camera in a resumed journal.
        self._resumed_path: dict[PathKind, float] = {}  # The last stamp of each path in that journal, in session time, s.
        self._restarts = OdometryRestarts(settings, counters)
        self._last: dict[PathKind, PoseMessage] = {}
        self._heard: dict[PathKind, OrderedDict[float, Floats]] = {}  # The newest poses by stamp, in session time, s.
        self._lead = Lead(self._clock, settings.poses.max_gap)
        self._leaps = StampLeaps[_Checked]()

    def push_camera(self, camera: Camera) -> bool:
        """Push a camera, as `Sink.push_camera`. A known camera that has not changed is accepted, but not delivered again."""
        sound = checks.sound_camera(camera)
        if isinstance(sound, str):
            return self._refuse(f"camera {sound}", checks.told(camera.name if isinstance(camera, Camera) else camera))
        with self._lock:
            known = self._cameras.get(sound.name)
            if known and all(np.array_equal(getattr(known, f.name), getattr(sound, f.name)) for f in fields(Camera)):
                return True
            if known is None and len(self._cameras) >= _MOST_CAMERAS:
                return self._refuse(f"camera beyond the first {_MOST_CAMERAS}", checks.told(sound.name))
            if not self._hand_on(CameraMessage(sound)):
                return False
            self._cameras[sound.name] = sound
            return True

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push odometry, as `Sink.push_odometry`. The covariance is ignored, because the drift comes from the settings."""
        return self._push_pose("odometry", stamp, odom_T_base)

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push a localisation, as `Sink.push_localization`. The covariance is ignored. The noise is in the settings."""
        return self._push_pose("localization", stamp, map_T_base)

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """Push a mount, as `Sink.push_mount`."""
        pose, given = checks.rigid(base_T_camera), checks.stamp_of(stamp)
        if pose is None or given is None:
            fault = "without a rigid pose" if pose is None else checks.stamp_fault(stamp)
            return self._refuse(f"mount {fault}", f"camera {checks.told(camera)}")
        with self._lock:
            if not checks.is_camera_name(camera) or camera not in self._cameras:
                return self._refuse("mount of an unknown camera", checks.told(camera))
            where = f"camera {camera}, stamp {given:.3f}"
            checked = _Checked(partial(self._take_mount, given, camera, pose), "mount", where)
            return self._take(f"mounts of {camera}", given, checked)

    def push_detections(
        self,
        stamp: float,
        camera: str,
        boxes: Floats,
        labels: Sequence[str],
        scores: Floats,
        depths: Floats | None = None,
        track_ids: Sequence[int] | None = None,
        whole: bool = False,
    ) -> bool:
        """Push boxes, as `Sink.push_detections`."""
        frame, fault, where, left_out = checks.sound_frame(stamp, camera, boxes, labels, scores, depths, track_ids, whole)
        for reason, count in left_out.items():
            self.counters.drop(reason, where, count)
        if frame is None:
            return self._refuse(fault, where)
        with self._lock:
            if camera not in self._cameras:
                return self._refuse("frame of an unknown camera", checks.told(camera))
            checked = _Checked(partial(self._take_frame, frame, where, time.perf_counter()), "frame", where)
            return self._take(f"frames of {camera}", frame.stamp, checked)

    def end(self) -> None:
        """Drop and count the messages that still wait for a confirmation of their stamps."""
        with self._lock:
            self._refute(self._leaps.clear())

    @property
    def newest(self) -> float:
        """The newest stamp of the path that sets the clock, in session time, s. It is -inf before the first pose."""
        return self._clock.newest

    def recall(self, message: Message) -> None:
        """Restore the state from a message of a journal, so that later pushes continue from it."""
        with self._lock:
            if isinstance(message, CameraMessage):
                self._cameras[message.camera.name] = message.camera
            elif isinstance(message, PoseMessage):
                self._last[message.path] = message
                self._resumed_path[message.path] = message.stamp
                self._keep(message)
                self._lead.choose(message.path, message.stamp)
                if message.path == self._lead.path:
                    self._clock.newest = message.stamp
                self._lead.heard(message.path, message.stamp)
                self._leaps.recall(message.path, message.stamp - self._clock.shift)
            elif isinstance(message, NoteMessage):
                self._clock.shift, self._restarts.start_T_odom = message.clock, message.odometry
            elif isinstance(message, FrameMessage):
                self._labels.update(message.labels)
                self._remember(message.camera, message.stamp)
                self._resumed[message.camera] = message.stamp
        self.counters.accept(_kind(message))
        if isinstance(message, FrameMessage):
            self.counters.accept("boxes", len(message))

    def _push_pose(self, path: PathKind, stamp: float, pose: Floats) -> bool:
        matrix, given = checks.rigid(pose), checks.stamp_of(stamp)
        if matrix is None or given is None:
            fault = "without a rigid pose" if matrix is None else checks.stamp_fault(stamp)
            return self._refuse(f"{path} {fault}", f"stamp {checks.told(stamp)}")
        if self._settings.poses.use not in ("auto", path):
            self.counters.accept(f"{path}{NOT_USED}")  # The user chose this (poses.use), so nothing is lost.
            return False
        with self._lock:
            checked = _Checked(partial(self._take_pose, path, given, matrix), path, f"stamp {given:.3f}")
            return self._take(path, given, checked, alone=True)

    def _take(self, stream: str, stamp: float, message: _Checked, alone: bool = False) -> bool:
        """Deliver a message of a stream and the messages that it confirms. Return whether it is accepted. stamp: s.

        The path that sets the clock confirms the stamps of all other streams. The stamps of this path are confirmed only by
        its own next poses. alone: as in `StampLeaps.take`.
        """
        clock = -math.inf if stream == self._lead.path else self._clock.newest - self._clock.shift
        passing, refuted = self._leaps.take(stream, stamp, clock, message, alone)
        self._refute(refuted)
        accepted = {id(one): one.push() for one in passing}
        if stream == self._lead.path:
            for one in self._leaps.confirmed(self._clock.newest - self._clock.shift):
                one.push()
        return accepted.get(id(message), True)

    def _refute(self, messages: list[_Checked]) -> None:
        for one in messages:
            self._refuse(f"{one.kind} {_ALONE}", one.where)

    def _take_pose(self, path: PathKind, given: float, pose: Floats) -> bool:
        """Deliver a pose, unless it is late. given: its stamp, s."""
        where, last = f"stamp {given:.3f}", self._last.get(path)
        self._lead.choose(path, given + self._clock.shift)
        if self._is_known(path, given + self._clock.shift, pose):
            self.counters.accept(f"{path}{CAME_BEFORE}")
            return False
        if path == self._lead.path:
            before = self.newest - self._clock.shift
            at, back = self._clock.step(given)
            if at is None:
                again = last is not None and last.stamp == given + self._clock.shift
                return self._refuse(f"{path} {'with a repeated stamp' if again else 'that is late'}", where)
            if back:
                if "clock set back" not in self.counters.accepted():
                    self.counters.ledger.warn(f"the clock was set back by about {before - given:.1f} s at {where}")
                self.counters.accept("clock set back")
                self._note()
                self._refute(self._leaps.clear())
                self._leaps.recall(path, given)
        else:
            at = self._place(given)
            if last is not None and at <= last.stamp:
                return self._refuse(f"{path} that is late", where)
        if path == "odometry":
            since = (None, math.inf) if last is None else (last.pose, at - last.stamp)
            pose, restarted = self._restarts.continued(pose, *since)
            if restarted:
                self._note()
            if not is_valid_position(*pose[:3, 3].tolist()):
                return self._refuse("odometry with a position out of range", where)
        message = PoseMessage(path, at, pose)
        if not self._hand_on(message):
            return False
        self._last[path] = message
        self._keep(message)
        self._lead.heard(path, at)
        return True

    def _take_frame(self, frame: FrameMessage, where: str, arrival: float) -> bool:
        """Deliver a frame of a known camera, unless it is late, repeated or far ahead of the path. arrival: s."""
        camera, at, newest = frame.camera, frame.stamp + self._clock.shift, self.newest
        if math.isfinite(newest):
            at = self._place(frame.stamp)
            if at > newest + _AHEAD:
                return self._refuse("frame with a stamp too far ahead of the path", where)
        seen, late = self._stamps.get(camera, {}), at < newest - self._settings.live.max_late
        if late or at in seen:
            if at <= self._resumed.get(camera, -math.inf):  # The source began again, as a replay does.
                self.counters.accept(f"frames{CAME_BEFORE}")
                return False
            return self._refuse(LATE_FRAME if late else "frame with a repeated stamp", where)
        if seen and at < next(reversed(seen)):
            self.counters.accept("frames out of order")
        frame = self._with_known_labels(frame, where)
        if not self._hand_on(replace(frame, stamp=at), arrival):
            return False
        self.counters.accept("boxes", len(frame))
        self._remember(camera, at)
        return True

    def _take_mount(self, stamp: float, camera: str, pose: Floats) -> bool:
        return self._hand_on(MountMessage(self._place(stamp), camera, pose))

    def _is_known(self, path: PathKind, at: float, pose: Floats) -> bool:
        """Return whether the session accepted the same pose before at the stamp `at` (s, session time).

        A match with the newest pose does not count, unless this pose is from an earlier session that this session resumes.
        """
        known = self._heard[path].get(at) if path in self._heard else None
        if known is None or (at >= self._last[path].stamp and at > self._resumed_path.get(path, -math.inf)):
            return False
        pose = self._restarts.start_T_odom @ pose if path == "odometry" else pose
        return bool(np.abs(known - pose).max() < _SAME_POSE)

    def _keep(self, message: PoseMessage) -> None:
        heard = self._heard.setdefault(message.path, OrderedDict())
        heard[message.stamp] = message.pose
        if len(heard) > _POSES:
            heard.popitem(last=False)  # A plain dict would search 10 us for its oldest entry.

    def _place(self, stamp: float) -> float:
        """Return the session time, s, of a mount, of a frame, or of a pose on the path that does not set the clock."""
        return self._clock.place(stamp, self.newest - self._settings.live.max_late, self.newest + _WAIT)

    def _with_known_labels(self, frame: FrameMessage, where: str) -> FrameMessage:
        """Return a frame without the boxes whose labels are beyond the first _MOST_LABELS of the session."""
        for label in dict.fromkeys(frame.labels):
            if len(self._labels) >= _MOST_LABELS:
                break
            self._labels.add(label)
        if self._labels.issuperset(frame.labels):
            return frame
        kept = [i for i, label in enumerate(frame.labels) if label in self._labels]
        self.counters.drop(f"box with a label beyond the first {_MOST_LABELS}", where, len(frame) - len(kept))
        columns = {name: getattr(frame, name)[kept] for name in ("boxes", "scores", "depths", "track_ids")}
        return replace(frame, labels=tuple(frame.labels[i] for i in kept), **columns)

    def _remember(self, camera: str, at: float) -> None:
        seen = self._stamps.setdefault(camera, {})
        seen[at] = None
        if len(seen) > _STAMPS:
            del seen[next(iter(seen))]

    def _note(self) -> None:
        self._hand_on(NoteMessage(self._clock.shift, self._restarts.start_T_odom))

    def _hand_on(self, message: Message, arrival: float | None = None) -> bool:
        """Deliver a message, count it if it is accepted, and return whether it is accepted. arrival: now, if None."""
        if not self._deliver(message, time.perf_counter() if arrival is None else arrival):
            return False
        self.counters.accept(_kind(message))
        return True

    def _refuse(self, reason: str, where: str | None = None) -> bool:
        self.counters.drop(reason, where)
        return False


def _kind(message: Message) -> str:
    return message.path if isinstance(message, PoseMessage) else _KINDS[type(message)]
