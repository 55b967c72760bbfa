"""The door of a session: every message is looked at, put on the session's own clock, handed on, and counted."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import inverse
from objslam.live.counters import Counters
from objslam.live.session import checks
from objslam.live.session.clock import Clock, Lead
from objslam.sources.journal.records import (
    CameraMessage,
    FrameMessage,
    Message,
    MountMessage,
    NoteMessage,
    PathKind,
    PoseMessage,
)

_JUMP = 0.1
"""m that odometry may step besides what live.max_speed allows; larger takes short restarts of the odometry for motion."""
_TURN = 0.3
"""rad that odometry may turn besides what its speed allows; larger takes more restarts for motion."""
_TURNS_PER_M = 4.0
"""rad/s that a robot may turn for each m/s of live.max_speed; larger takes more restarts for motion."""
_ZERO = 0.05
"""m and rad; odometry that is so near to zero after a gap has started again. Larger takes more motion for a restart."""
_FAR = 0.1
"""m and rad from zero that it must have been before the gap for that; larger takes more restarts for motion."""
_STAMPS = 256
"""Stamps of one camera that are remembered to tell duplicates; more find those that come later."""
_WAIT = 2.0
"""s that a stamp may be ahead of the path before an older clock is tried; larger takes old stamps for new ones."""
_AHEAD = 60.0
"""s that a frame may be ahead of the path at all; larger lets one wrong stamp wait for longer."""


class Intake:
    """A `Sink` that hands on what is sound, in session time: stamps of the path increase, odometry is continuous.

    deliver(message, arrival) is called with one message at a time, by the thread that pushed; it says whether it was taken,
    and counts what it does not take.
    """

    def __init__(self, settings: Settings, counters: Counters, deliver: Callable[[Message, float], bool]) -> None:
        self._settings, self._counters, self._deliver = settings, counters, deliver
        self._lock = threading.Lock()
        self._clock = Clock()
        self._cameras: dict[str, Camera] = {}
        self._stamps: dict[str, tuple[deque[float], set[float]]] = {}
        self._start_T_odom = np.eye(4)
        self._last: dict[PathKind, PoseMessage] = {}
        self._lead = Lead(self._clock, settings.poses.max_gap)

    def push_camera(self, camera: Camera) -> bool:
        """As `Sink` says; the same camera again is no news."""
        sound = checks.sound_camera(camera)
        if isinstance(sound, str):
            return self._refuse(f"camera {sound}", checks.told(camera.name if isinstance(camera, Camera) else camera))
        with self._lock:
            known = self._cameras.get(sound.name)
            if known is not None and _same_camera(known, sound):
                return True
            if not self._hand_on(CameraMessage(sound), "cameras"):
                return False
            self._cameras[sound.name] = sound
            return True

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says. The drift is that of the settings; a covariance is not used."""
        return self._push_pose("odometry", stamp, odom_T_base)

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says. The noise is that of the settings; a covariance is not used."""
        return self._push_pose("localization", stamp, map_T_base)

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """As `Sink` says."""
        pose, given = checks.rigid(base_T_camera), checks.stamp_of(stamp)
        if pose is None or given is None:
            return self._refuse("mount that is no pose, or without a stamp", f"camera {checks.told(camera)}")
        with self._lock:
            if not checks.is_camera_name(camera) or camera not in self._cameras:
                return self._refuse("mount of an unknown camera", checks.told(camera))
            newest = self._clock.newest
            at = self._clock.place(given, newest - self._settings.live.max_late, newest + _WAIT)
            return self._hand_on(MountMessage(at, camera, pose), "mounts")

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
        """As `Sink` says."""
        frame, fault, where, left_out = checks.sound_frame(stamp, camera, boxes, labels, scores, depths, track_ids, whole)
        for reason, count in left_out.items():
            self._counters.drop(reason, where, count)
        if frame is None:
            return self._refuse(fault, where)
        with self._lock:
            if camera not in self._cameras:
                return self._refuse("frame of an unknown camera", checks.told(camera))
            late, newest = self._settings.live.max_late, self._clock.newest
            at = frame.stamp
            if math.isfinite(newest):
                at = self._clock.place(frame.stamp, newest - late, newest + _WAIT)
                if at < newest - late:
                    return self._refuse("frame that is late (live.max_late)", where)
                if at > newest + _AHEAD:
                    return self._refuse("frame from the future", where)
            order, seen = self._stamps.setdefault(camera, (deque(), set()))
            if at in seen:
                return self._refuse("frame that came before", where)
            if order and at < order[-1]:
                self._counters.accept("frames out of order")
            if not self._hand_on(replace(frame, stamp=at), "frames"):
                return False
            self._counters.accept("boxes", len(frame.labels))
            self._remember(camera, at)
            return True

    @property
    def newest(self) -> float:
        """The newest stamp of the path that leads, s; -inf without any."""
        return self._clock.newest

    def recall(self, message: Message) -> None:
        """Take note of a message that a journal holds, so that what is pushed next goes on from it."""
        with self._lock:
            if isinstance(message, CameraMessage):
                self._cameras[message.camera.name] = message.camera
            elif isinstance(message, PoseMessage):
                self._last[message.path] = message
                self._lead.choose(message.path, message.stamp)
                if message.path == self._lead.path:
                    self._clock.newest = message.stamp
                self._lead.heard(message.path, message.stamp)
            elif isinstance(message, NoteMessage):
                self._clock.shift, self._start_T_odom = message.clock, message.odometry
            elif isinstance(message, FrameMessage):
                self._remember(message.camera, message.stamp)
        self._counters.accept(_KIND[type(message)] if not isinstance(message, PoseMessage) else message.path)
        if isinstance(message, FrameMessage):
            self._counters.accept("boxes", len(message))

    def _push_pose(self, path: PathKind, stamp: float, pose: Floats) -> bool:
        matrix, given = checks.rigid(pose), checks.stamp_of(stamp)
        if matrix is None or given is None:
            return self._refuse(f"{path} that is no pose, or without a stamp", f"stamp {checks.told(stamp)}")
        use = self._settings.poses.use
        if use not in ("auto", path):
            return self._refuse(f"{path} that is not used (poses.use)")
        with self._lock:
            self._lead.choose(path, given + self._clock.shift)
            if path == self._lead.path:
                at, back = self._clock.step(given)
                if at is None:
                    last = self._last.get(path)
                    again = last is not None and last.stamp == given + self._clock.shift
                    return self._refuse(f"{path} that {'came before' if again else 'is late'}", f"stamp {given:.3f}")
                if back:
                    self._counters.accept("clock set back")
                    self._note()
            else:
                newest = self._clock.newest
                at = self._clock.place(given, newest - self._settings.live.max_late, newest + _WAIT)
                before = self._last.get(path)
                if before is not None and at <= before.stamp:
                    return self._refuse(f"{path} that is late", f"stamp {given:.3f}")
            if path == "odometry":
                matrix = self._continuous(at, matrix)
            message = PoseMessage(path, at, matrix)
            if not self._hand_on(message, path):
                return False
            self._last[path] = message
            self._lead.heard(path, at)
            return True

    def _continuous(self, at: float, odom_T_base: Floats) -> Floats:
        """The pose in the frame of the first odometry, which goes on when the robot's odometry starts again."""
        last = self._last.get("odometry")
        pose = self._start_T_odom @ odom_T_base
        if last is None:
            return pose
        gap = at - last.stamp
        if gap > self._settings.poses.max_gap:
            self._counters.accept("gaps of the odometry")
        way, turn = _size(inverse(last.pose) @ pose)
        fast = self._settings.live.max_speed
        jumped = way > fast * gap + _JUMP or turn > _TURNS_PER_M * fast * gap + _TURN
        if gap > self._settings.poses.max_gap and max(_size(odom_T_base)) < _ZERO:
            jumped |= max(_size(inverse(self._start_T_odom) @ last.pose)) > _FAR
        if jumped:
            self._counters.accept("odometry started anew")
            self._start_T_odom = last.pose @ inverse(odom_T_base)
            self._note()
            return np.asarray(self._start_T_odom @ odom_T_base)
        return np.asarray(pose)

    def _remember(self, camera: str, at: float) -> None:
        order, seen = self._stamps.setdefault(camera, (deque(), set()))
        order.append(at)
        seen.add(at)
        if len(order) > _STAMPS:
            seen.discard(order.popleft())

    def _note(self) -> None:
        self._hand_on(NoteMessage(self._clock.shift, self._start_T_odom), "notes")

    def _hand_on(self, message: Message, kind: str) -> bool:
        """To the session, which keeps it, and into the counters, in this order: what is counted is not lost."""
        if not self._deliver(message, time.perf_counter()):
            return False
        self._counters.accept(kind)
        return True

    def _refuse(self, reason: str, where: str | None = None) -> bool:
        self._counters.drop(reason, where)
        return False


_KIND = {CameraMessage: "cameras", MountMessage: "mounts", FrameMessage: "frames", NoteMessage: "notes"}


def _size(pose: Floats) -> tuple[float, float]:
    """How far (m) and by what angle (rad) a pose (4, 4) moves."""
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(pose)) - 2.0) / 2.0)))
    return math.hypot(*pose[:3, 3]), angle


def _same_camera(a: Camera, b: Camera) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Camera))
