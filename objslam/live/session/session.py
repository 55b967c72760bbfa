"""A session: what is pushed from any thread becomes a map in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.snapshot import Snapshot
from objslam.core.types import Trajectory
from objslam.errors import OutputError, one_line
from objslam.live.counters import Counters
from objslam.live.mapper.mapper import Mapper
from objslam.live.session.finalize import finish
from objslam.live.session.frame_queue import TOO_SLOW, FrameQueue
from objslam.live.session.intake import Intake
from objslam.live.session.snapshots import Describer, take_snapshot
from objslam.sources.journal.file import Journal, messages
from objslam.sources.journal.records import FrameMessage, Message, NoteMessage

_MOST_POSES = 20_000
"""Messages besides frames that may wait, 100 s of odometry at 200 Hz; more cost memory."""
_IDLE = 0.05
"""s until the thread looks up where nothing comes, and that a snapshot waits for the next frame; longer answers later."""
_SHORT = 0.015
"""s; after a frame that took longer no snapshot is made, for the next one may be there. Longer delays more frames."""
_LONG = 0.5
"""s; a snapshot that has been waited for longer is made after any frame. Longer answers later while frames take long."""
_PATIENCE = 5.0
"""s that a snapshot is waited for until the last one is returned; longer keeps the caller waiting."""


class Session:
    """Implements `Sink`. `start` it, push from any thread, take a `snapshot` at any time, `stop` it for the result.

    journal: a file that every accepted message is written to first. resume: go on with the journal that is there; its
    messages are worked in by `start`. Not more than one session writes a journal. patient: no frame is too old, for a
    source that waits for the session.

    An error in the session's thread ends it early: `failure` tells, nobody who waits for the session goes on waiting, what
    is pushed is refused, and `stop` gives the result of what came until then.
    """

    def __init__(
        self,
        settings: Settings,
        journal: Path | None = None,
        resume: bool = False,
        name: str = "live",
        patient: bool = False,
    ) -> None:
        self._settings, self._name = settings, name
        self.counters = Counters()
        self._mapper = Mapper(settings, self.counters)
        self._frames_waiting = FrameQueue(settings, self.counters, self._mapper, patient)
        self._journal_file, self._resume = journal, resume
        self._journal = Journal(journal, resume) if journal is not None else None
        if self._journal is not None and self._journal.torn:
            self.counters.drop("torn record at the end of the journal", f"{journal}, {self._journal.torn} bytes")
        self._intake = Intake(settings, self.counters, self._enqueue)
        self._queue: deque[tuple[Message, float]] = deque()
        self._taken: deque[tuple[Message, float]] = deque()
        self._frames = self._others = 0
        self._changed = threading.Condition()
        self._busy = False
        self._wanted = 0
        self._given = 0
        self._running = self._stopping = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="objslam session", daemon=True)
        self._describer = Describer()
        self._asked = -np.inf
        self._snapshot = Snapshot(np.nan, ObjectMap(()), Trajectory(np.zeros(0), np.zeros((0, 4, 4))))

    def start(self) -> Self:
        """Work in what the journal holds, then begin to take messages."""
        import cv2  # noqa: F401 - now, for the first frame should not wait for it

        self._guard(self._go_on)
        if self._failure is None:
            self._running = True
            self._thread.start()
        else:
            self._end()
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
            if not self._running:
                return self._snapshot
            if self._wanted == self._given:
                self._asked = time.perf_counter()
            self._wanted += 1
            number = self._wanted
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._given >= number or not self._running, _PATIENCE)
            return self._snapshot

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until everything pushed so far is worked in; whether it is.

        A session that ended early, or was never started, is not waited for.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_done() or not self._running, timeout)
            return self._is_done() and self._failure is None

    @property
    def backlog(self) -> int:
        """Messages that wait."""
        return len(self._queue)

    def stop(self) -> RunResult:
        """Work in what was pushed, end the thread, and solve everything once more.

        After a `failure` the result is of what came until then, and the ledger is warned; the failure itself is raised where
        there is none. SolveError where nothing was seen that could be mapped.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._close()
        if self._failure is None:
            return finish(self._mapper.state, self._name, self._journal_file)
        said = one_line(self._failure)
        self.counters.ledger.warn(f"the session ended early, the map is of what came until then: {said}")
        try:
            return finish(self._mapper.state, self._name, self._journal_file)
        except Exception as error:  # the failure left nothing to make a result of
            raise self._failure from error

    def abort(self) -> None:
        """End the thread and let go of the journal, without a result."""
        with self._changed:
            self._stopping = True
            self._queue.clear()
            self._changed.notify_all()
        self._close()

    @property
    def newest(self) -> float:
        """The newest stamp of the path, s; -inf without any."""
        return self._intake.newest

    @property
    def failure(self) -> Exception | None:
        """The error that ended the session early, None without one."""
        return self._failure

    def _close(self) -> None:
        """Wait for the thread's end, then let go of the journal; no push writes there any more."""
        if self._thread.is_alive():
            self._thread.join()
        if self._journal is not None:
            try:
                self._journal.close()
            except OutputError as error:  # the map is worth more
                self.counters.ledger.warn(str(error))

    def _enqueue(self, message: Message, arrival: float) -> bool:
        """Put a message into the journal, then into the queue: into both or none, so that what is journalled was accepted.

        A note is for the journal alone.
        """
        with self._changed:
            if self._stopping:
                self.counters.drop("messages after the end")
                return False
            frame, note = isinstance(message, FrameMessage), isinstance(message, NoteMessage)
            if not frame and not note and self._others >= _MOST_POSES:
                self.counters.drop("poses that found no place in the queue")
                return False
            if self._journal is not None:
                try:
                    self._journal.write(message)
                except OutputError as error:
                    self.counters.drop(f"messages that the journal could not take: {error.message}")
                    return False
            if not note:
                self._queue.append((message, arrival))
                self._frames, self._others = self._frames + frame, self._others + (not frame)
                if self._frames > self._settings.live.max_frames_waiting:
                    self._drop_oldest_frame()
                self._changed.notify_all()
        return True

    def _drop_oldest_frame(self) -> None:
        for i, (message, _) in enumerate(self._queue):
            if isinstance(message, FrameMessage):
                del self._queue[i]
                self._frames -= 1
                self.counters.drop_frame(message, TOO_SLOW)
                return

    def _go_on(self) -> None:
        """Work in what the journal holds, where the session resumes."""
        past = messages(self._journal_file, self.counters.ledger) if self._journal_file and self._resume else ()
        for message in past:
            self._intake.recall(message)
            self._frames_waiting.recall(message)

    def _work(self) -> None:
        self._guard(self._serve)
        self._end()

    def _serve(self) -> None:
        """Work in what comes, until the session is to stop."""
        while True:
            with self._changed:
                self._busy = False
                if not self._queue:
                    self._changed.notify_all()
                    if self._stopping:
                        return
                    self._changed.wait(self._idle())
                self._taken.extend(self._queue)
                self._queue.clear()
                self._frames = self._others = 0
                self._busy = bool(self._taken)
            begin, worked = time.perf_counter(), False
            while self._taken:
                worked |= self._frames_waiting.take(*self._taken.popleft())
            if self._has_time(worked, begin):
                self._answer()

    def _guard(self, work: Callable[[], None]) -> None:
        """Do work whose error ends the session: the first is kept for whoever stops it, for a thread has nobody to tell."""
        try:
            work()
        except Exception as error:  # noqa: BLE001 - told as the session's `failure`
            self._failure = self._failure or error

    def _end(self) -> None:
        """The last snapshot; what was not worked in is counted, and whoever waits goes on."""
        with self._changed:
            self._stopping = True
        self._guard(self._answer)
        with self._changed:
            left = len(self._taken) + len(self._queue)
            self.counters.drop("messages that waited when the session ended early", count=left)
            self._taken.clear()
            self._queue.clear()
            self._busy = self._running = False
            self._changed.notify_all()

    def _is_done(self) -> bool:
        return not self._queue and not self._busy

    def _idle(self) -> float:
        """How long nothing needs to be done where nothing comes, s."""
        return _IDLE if self._wanted == self._given else max(0.0, self._frames_waiting.worked + _IDLE - time.perf_counter())

    def _has_time(self, worked: bool, begin: float) -> bool:
        """Whether to answer now: right after a frame that took little, for then the next one is furthest away."""
        now = time.perf_counter()
        return now - self._frames_waiting.worked > _IDLE or (worked and (now - begin < _SHORT or now - self._asked > _LONG))

    def _answer(self) -> None:
        """A new snapshot, where one is wanted, or the session ends."""
        wanted = self._wanted
        if wanted == self._given and not self._stopping:
            return
        snapshot = take_snapshot(self._mapper.state, self._describer, self._frames_waiting.lag, whole=self._stopping)
        with self._changed:
            self._snapshot, self._given = snapshot, wanted
            self._changed.notify_all()
