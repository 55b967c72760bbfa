"""The door of a session: every message is looked at, put on the session's own clock, journalled, and counted."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np

from objslam.config import Settings
from objslam.errors import OutputError
from objslam.geometry import inverse
from objslam.live.clock import Clock
from objslam.live.counters import Counters
from objslam.live.journal import Journal
from objslam.live.messages import CameraMessage, FrameMessage, Message, MountMessage, NoteMessage, PathKind, PoseMessage
from objslam.sources.camera_file import COEFFICIENTS
from objslam.types import Bools, Camera, Floats

_RIGID = 1e-3  # how far a rotation may be from one
_JUMP = 0.1  # m; so far odometry may step besides what its speed allows,
_TURN = 0.3  # rad; and turn,
_TURNS_PER_M = 4.0  # rad/s for each m/s of the greatest speed
_ZERO = 0.05  # m, rad; after a gap, odometry that is so near zero started anew
_FAR = 0.1  # m, rad; unless it was that near before
_STAMPS = 256  # of one camera that are remembered, to tell duplicates
_LARGEST = 1e9  # m; positions beyond it are no positions
_WAIT = 2.0  # s; how far a frame's stamp may be ahead of the path before another clock is tried,
_AHEAD = 60.0  # s; and at all


class Intake:
    """A `Sink` that hands on what is sound, in session time: stamps of the path increase, odometry is continuous.

    deliver(message, arrival) is called with one message at a time, by the thread that pushed; it says whether it was taken.
    """

    def __init__(
        self, settings: Settings, counters: Counters, deliver: Callable[[Message, float], bool], journal: Journal | None
    ) -> None:
        self._settings, self._counters, self._deliver, self._journal = settings, counters, deliver, journal
        self._lock = threading.Lock()
        self._clock = Clock()
        self._cameras: dict[str, Camera] = {}
        self._stamps: dict[str, tuple[deque[float], set[float]]] = {}
        self._start_T_odom = np.eye(4)
        self._last: dict[PathKind, PoseMessage] = {}
        self._leads: PathKind | None = None

    def push_camera(self, camera: Camera) -> bool:
        """As `Sink` says; the same camera again is no news."""
        wrong = _wrong_camera(camera)
        if wrong:
            return self._refuse(f"camera {wrong}", str(getattr(camera, "name", "?")))
        with self._lock:
            known = self._cameras.get(camera.name)
            if known is not None and _same_camera(known, camera):
                return True
            if not self._hand_on(CameraMessage(camera), "cameras"):
                return False
            self._cameras[camera.name] = camera
            return True

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says. The drift is that of the settings; a covariance is not used."""
        return self._push_pose("odometry", stamp, odom_T_base)

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says. The noise is that of the settings; a covariance is not used."""
        return self._push_pose("localization", stamp, map_T_base)

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """As `Sink` says."""
        pose = _pose(base_T_camera)
        if pose is None or not _finite(stamp):
            return self._refuse("mount that is no pose, or without a stamp", f"camera {camera}")
        with self._lock:
            if camera not in self._cameras:
                return self._refuse("mount of an unknown camera", str(camera))
            newest = self._clock.newest
            at = self._clock.place(float(stamp), newest - self._settings.live.max_late, newest + _WAIT)
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
        where = f"camera {camera}"
        if not _finite(stamp):
            return self._refuse("frame without a stamp", where)
        frame = self._frame(float(stamp), camera, boxes, labels, scores, depths, track_ids, whole)
        if frame is None:
            return self._refuse("frame that is malformed", f"{where}, stamp {stamp:.3f}")
        with self._lock:
            if camera not in self._cameras:
                return self._refuse("frame of an unknown camera", str(camera))
            late, newest = self._settings.live.max_late, self._clock.newest
            at = frame.stamp
            if math.isfinite(newest):
                at = self._clock.place(frame.stamp, newest - late, newest + _WAIT)
                if at < newest - late:
                    return self._refuse("frame that is late (live.max_late)", f"{where}, stamp {stamp:.3f}")
                if at > newest + _AHEAD:
                    return self._refuse("frame from the future", f"{where}, stamp {stamp:.3f}")
            order, seen = self._stamps.setdefault(camera, (deque(), set()))
            if at in seen:
                return self._refuse("frame that came before", f"{where}, stamp {stamp:.3f}")
            if order and at < order[-1]:
                self._counters.accept("frames out of order")
            values = {**vars(frame), "stamp": at}
            if not self._hand_on(FrameMessage(**values), "frames"):
                return False
            self._counters.accept("boxes", len(frame))
            self._remember(camera, at)
            return True

    @property
    def newest(self) -> float:
        """The newest stamp of the path, s; -inf without any."""
        return self._clock.newest

    def recall(self, message: Message) -> None:
        """Take note of a message that a journal holds, so that what is pushed next goes on from it."""
        with self._lock:
            if isinstance(message, CameraMessage):
                self._cameras[message.camera.name] = message.camera
            elif isinstance(message, PoseMessage):
                self._last[message.path] = message
                self._leads = "odometry" if "odometry" in self._last else "localization"
                if message.path == self._leads:
                    self._clock.newest = message.stamp
            elif isinstance(message, NoteMessage):
                self._clock.shift, self._start_T_odom = message.clock, message.odometry
            elif isinstance(message, FrameMessage):
                self._remember(message.camera, message.stamp)
        self._counters.accept(_KIND[type(message)] if not isinstance(message, PoseMessage) else message.path)
        if isinstance(message, FrameMessage):
            self._counters.accept("boxes", len(message))

    def _push_pose(self, path: PathKind, stamp: float, pose: Floats) -> bool:
        matrix = _pose(pose)
        if matrix is None or not _finite(stamp):
            return self._refuse(f"{path} that is no pose, or without a stamp", f"stamp {stamp}")
        use = self._settings.poses.use
        if use not in ("auto", path):
            return self._refuse(f"{path} that is not used (poses.use)")
        with self._lock:
            if self._leads == "localization" and path == "odometry":
                self._clock.newest = -math.inf  # the path begins where the odometry does, be that before the localization
            if self._leads is None or path == "odometry":
                self._leads = path
            if path == self._leads:
                at, back = self._clock.step(float(stamp))
                if at is None:
                    last = self._last.get(path)
                    again = last is not None and last.stamp == stamp + self._clock.shift
                    return self._refuse(f"{path} that {'came before' if again else 'is late'}", f"stamp {stamp:.3f}")
                if back:
                    self._counters.accept("clock set back")
                    self._note()
            else:
                newest = self._clock.newest
                at = self._clock.place(float(stamp), newest - self._settings.live.max_late, newest + _WAIT)
                before = self._last.get(path)
                if before is not None and at <= before.stamp:
                    return self._refuse(f"{path} that is late", f"stamp {stamp:.3f}")
            if path == "odometry":
                matrix = self._continuous(at, matrix)
            message = PoseMessage(path, at, matrix)
            if not self._hand_on(message, path):
                return False
            self._last[path] = message
            return True

    def _continuous(self, at: float, odom_T_base: Floats) -> Floats:
        """The pose in the frame of the first odometry, which goes on when the robot's odometry starts anew."""
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

    def _frame(
        self,
        stamp: float,
        camera: str,
        boxes: Floats,
        labels: Sequence[str],
        scores: Floats,
        depths: Floats | None,
        track_ids: Sequence[int] | None,
        whole: bool,
    ) -> FrameMessage | None:
        """The frame without boxes that cannot be right, which are counted; None where it is malformed as a whole."""
        try:
            count = len(labels)
            corners = np.array(boxes, dtype=np.float64).reshape(count, 4)
            score = np.array(scores, dtype=np.float64).reshape(count)
            depth = np.full(count, np.nan) if depths is None else np.array(depths, dtype=np.float64).reshape(count)
            track = np.array([-1] * count if track_ids is None else track_ids, dtype=np.int64).reshape(count)
        except (ValueError, TypeError, OverflowError):
            return None
        if not isinstance(camera, str):
            return None
        good = np.ones(count, dtype=bool)
        names = np.array([isinstance(n, str) and bool(n.strip()) and n.isprintable() for n in labels], dtype=bool)
        with np.errstate(invalid="ignore"):
            area = (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
        finite = np.asarray(np.isfinite(corners).all(axis=1))
        checks: tuple[tuple[Bools, str], ...] = (
            (finite, "box with a corner that is not finite"),
            (area, "box without area (x2 <= x1 or y2 <= y1)"),
            ((score >= 0) & (score <= 1), "box with a score outside 0 to 1"),
            (names, "box with a label that is empty or not printable"),
        )
        for fine, reason in checks:
            if not fine.all():
                self._counters.drop(reason, f"camera {camera}, stamp {stamp:.3f}", int((good & ~fine).sum()))
                good &= fine
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
        kept = np.flatnonzero(good)
        names_kept = tuple(labels[i] for i in kept.tolist())
        return FrameMessage(stamp, camera, corners[kept], names_kept, score[kept], depth[kept], track[kept], bool(whole))

    def _remember(self, camera: str, at: float) -> None:
        order, seen = self._stamps.setdefault(camera, (deque(), set()))
        order.append(at)
        seen.add(at)
        if len(order) > _STAMPS:
            seen.discard(order.popleft())

    def _note(self) -> None:
        self._hand_on(NoteMessage(self._clock.shift, self._start_T_odom), "notes")

    def _hand_on(self, message: Message, kind: str) -> bool:
        """To the disk, to the session, and into the counters, in this order: what is counted is not lost."""
        arrival = time.perf_counter()
        if self._journal is not None:
            try:
                self._journal.write(message)
            except OutputError as error:
                return self._refuse(f"messages that the journal could not take: {error.message}")
        if not self._deliver(message, arrival):
            return False
        self._counters.accept(kind)
        return True

    def _refuse(self, reason: str, where: str | None = None) -> bool:
        self._counters.drop(reason, where)
        return False


_KIND = {CameraMessage: "cameras", MountMessage: "mounts", FrameMessage: "frames", NoteMessage: "notes"}


def _finite(stamp: float) -> bool:
    try:
        return math.isfinite(stamp)
    except (TypeError, OverflowError):
        return False


def _pose(pose: Floats) -> Floats | None:
    """The rigid pose (4, 4) as an array of its own, None where it is none."""
    try:
        matrix = np.array(pose, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        return None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.abs(matrix[:3, 3]).max() > _LARGEST:
        return None
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        return None
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def _size(pose: Floats) -> tuple[float, float]:
    """How far (m) and by what angle (rad) a pose (4, 4) moves."""
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(pose)) - 2.0) / 2.0)))
    return math.hypot(*pose[:3, 3]), angle


def _wrong_camera(camera: Camera) -> str | None:
    if not isinstance(camera, Camera) or not isinstance(camera.name, str) or not camera.name:
        return "without a name"
    matrix, distortion = camera.matrix, camera.distortion
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        return "without a calibration"
    if camera.width <= 0 or camera.height <= 0:
        return "without a size"
    if len(distortion) not in COEFFICIENTS.get(camera.distortion_model, ()) or not np.isfinite(distortion).all():
        return "with a lens model that is not known"
    return None if _pose(camera.base_T_camera) is not None else "whose mount is no pose"


def _same_camera(a: Camera, b: Camera) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Camera))
