"""A session: what is pushed from any thread becomes a map in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.live.counters import Counters
from objslam.live.finish import finish
from objslam.live.intake import Intake
from objslam.live.interface import Snapshot
from objslam.live.journal import Journal, messages
from objslam.live.mapper import Mapper
from objslam.live.messages import FrameMessage, Message
from objslam.live.snapshots import Describer, frames, path
from objslam.results import RunResult
from objslam.types import Camera, Floats, ObjectMap, Trajectory

_MOST_POSES = 20_000  # messages besides frames that may wait: 100 s of odometry at 200 Hz
_IDLE = 0.05  # s; how often the worker looks up where nothing comes, and how long a snapshot waits for the next frame
_SHORT = 0.015  # s; a frame that took longer had better not be followed by a snapshot,
_LONG = 0.5  # s; unless that has been waited for for so long
_PATIENCE = 5.0  # s; how long a snapshot is waited for
_TOO_SLOW = "frames that waited too long (live.max_lag)"
_RARE_POSES = "frames whose pose came more than live.max_lag later: poses are too rare or late, or it is too short"


class Session:
    """Implements `Sink`. `start` it, push from any thread, take a `snapshot` at any time, `stop` it for the result.

    journal: a file that every accepted message is written to first. resume: go on with the journal that is there; its
    messages are worked in by `start`. Not more than one session writes a journal. patient: no frame is too old, for a
    source that waits for the session.
    """

    def __init__(
        self,
        settings: Settings,
        journal: Path | None = None,
        resume: bool = False,
        name: str = "live",
        patient: bool = False,
    ) -> None:
        self._settings, self._name, self._patient = settings, name, patient
        self.counters = Counters()
        self._mapper = Mapper(settings, self.counters)
        self._journal_file, self._resume = journal, resume
        self._journal = Journal(journal, resume) if journal is not None else None
        if self._journal is not None and self._journal.torn:
            self.counters.drop("torn record at the end of the journal", f"{journal}, {self._journal.torn} bytes")
        self._intake = Intake(settings, self.counters, self._enqueue, self._journal)
        self._queue: deque[tuple[Message, float]] = deque()
        self._frames = self._others = 0
        self._changed = threading.Condition()
        self._busy = False
        self._wanted = 0
        self._given = 0
        self._stopping = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="objslam session", daemon=True)
        self._describer = Describer()
        self._lag = 0.0
        self._worked = self._asked = -np.inf
        self._snapshot = Snapshot(np.nan, ObjectMap(()), Trajectory(np.zeros(0), np.zeros((0, 4, 4))))

    def start(self) -> Self:
        """Work in what the journal holds, then begin to take messages."""
        import cv2  # noqa: F401 - now, for the first frame should not wait for it

        past = messages(self._journal_file, self.counters.ledger) if self._journal_file and self._resume else ()
        for message in past:
            self._intake.recall(message)
            self._mapper.feed(message, time.perf_counter())
            self._work_off()
        self._thread.start()
        return self

    def push_camera(self, camera: Camera) -> bool:
        """As `Sink` says."""
        return self._intake.push_camera(camera)

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says."""
        return self._intake.push_odometry(stamp, odom_T_base, covariance)

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """As `Sink` says."""
        return self._intake.push_localization(stamp, map_T_base, covariance)

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """As `Sink` says."""
        return self._intake.push_mount(stamp, camera, base_T_camera)

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
        return self._intake.push_detections(stamp, camera, boxes, labels, scores, depths, track_ids, whole)

    def snapshot(self) -> Snapshot:
        """The map as of now; the last one where the session has stopped, or is too busy to answer within seconds."""
        with self._changed:
            if not self._thread.is_alive():
                return self._snapshot
            if self._wanted == self._given:
                self._asked = time.perf_counter()
            self._wanted += 1
            number = self._wanted
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._given >= number or not self._thread.is_alive(), _PATIENCE)
            return self._snapshot

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until everything pushed so far is worked in; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._queue and not self._busy, timeout)

    @property
    def backlog(self) -> int:
        """Messages that wait."""
        return len(self._queue)

    def stop(self) -> RunResult:
        """Work in what was pushed, end the thread, and solve everything once more.

        SolveError where nothing was seen that could be mapped; whatever ended the thread before.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        if self._journal is not None:
            self._journal.close()
        if self._failure is not None:
            raise self._failure
        return finish(self._mapper, self._name, self._journal_file)

    def abort(self) -> None:
        """End the thread and let go of the journal, without a result."""
        with self._changed:
            self._stopping = True
            self._queue.clear()
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        if self._journal is not None:
            self._journal.close()

    @property
    def newest(self) -> float:
        """The newest stamp of the path, s; -inf without any."""
        return self._intake.newest

    @property
    def failed(self) -> bool:
        """Whether the session's thread has ended by an error, which `stop` raises."""
        return self._failure is not None

    def _enqueue(self, message: Message, arrival: float) -> bool:
        with self._changed:
            if self._stopping:
                self.counters.drop("messages after the end")
                return False
            if isinstance(message, FrameMessage):
                self._frames += 1
                if self._frames > self._settings.live.max_frames_waiting:
                    self._drop_oldest_frame()
            else:
                if self._others >= _MOST_POSES:
                    self.counters.drop("poses that found no place in the queue")
                    return False
                self._others += 1
            self._queue.append((message, arrival))
            self._changed.notify_all()
        return True

    def _drop_oldest_frame(self) -> None:
        for i, (message, _) in enumerate(self._queue):
            if isinstance(message, FrameMessage):
                del self._queue[i]
                self._frames -= 1
                self._mapper.leave_out(message, _TOO_SLOW)
                return

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._busy = False
                    if not self._queue:
                        self._changed.notify_all()
                        if self._stopping:
                            break
                        self._changed.wait(self._idle())
                    taken = list(self._queue)
                    self._queue.clear()
                    self._frames = self._others = 0
                    self._busy = bool(taken)
                begin = time.perf_counter()
                worked = [self._take(message, arrival) for message, arrival in taken]
                if self._has_time(any(worked), begin):
                    self._answer()
        except Exception as error:  # noqa: BLE001 - kept for whoever stops the session: a thread has nobody to tell
            self._failure = error
        finally:
            self._answer()
            with self._changed:
                self._busy = False
                self._stopping = True
                self._changed.notify_all()

    def _idle(self) -> float:
        """How long nothing needs to be done where nothing comes, s."""
        return _IDLE if self._wanted == self._given else max(0.0, self._worked + _IDLE - time.perf_counter())

    def _has_time(self, worked: bool, begin: float) -> bool:
        """Whether to answer now: right after a frame that took little, for then the next one is furthest away."""
        now = time.perf_counter()
        return now - self._worked > _IDLE or (worked and (now - begin < _SHORT or now - self._asked > _LONG))

    def _take(self, message: Message, arrival: float) -> bool:
        """Feed a message; whether it was a frame's turn."""
        self._mapper.feed(message, arrival)
        return self._work_off(arrival)

    def _work_off(self, newest: float | None = None) -> bool:
        """Work in the frames that are ready; whether there was one.

        newest: when the message arrived that made them ready; without it they are not measured, and none is too old.
        """
        worked = False
        while (found := self._mapper.ready()) is not None:
            worked, (frame, arrival) = True, found
            limit = self._settings.live.max_lag
            if newest is not None and not self._patient and time.perf_counter() - arrival > limit:
                self._mapper.leave_out(frame, _RARE_POSES if newest - arrival > limit else _TOO_SLOW)
                continue
            if self._mapper.take(frame):
                self._lag = time.perf_counter() - arrival
                if newest is not None:
                    self.counters.updated(self._lag)
                self._mapper.look_after()
        if worked:
            self._worked = time.perf_counter()
        return worked

    def _answer(self) -> None:
        """A new snapshot, where one is wanted, or the session ends."""
        wanted = self._wanted
        if wanted == self._given and not self._stopping:
            return
        m = self._mapper
        snapshot = Snapshot(
            stamp=float(m.keyframes.stamp.max()) if len(m.keyframes) else np.nan,
            map=self._describer.map(m, whole=self._stopping),
            path=path(m),
            frames=frames(m),
            keyframes=m.keyframes_so_far,
            rebuilds=m.graph.rebuilds,
            lag=self._lag,
            update=self.counters.update(),
            counters=self.counters.accepted(),
            dropped=self.counters.dropped(),
        )
        with self._changed:
            self._snapshot, self._given = snapshot, wanted
            self._changed.notify_all()
