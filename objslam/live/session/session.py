"""A session. Any thread pushes messages, and the session's own thread makes a map of them."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from objslam.config import Settings
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.snapshot import TOO_SLOW, Snapshot
from objslam.core.trajectory import Trajectory
from objslam.errors import OutputError, one_line
from objslam.io.threads import start_thread
from objslam.live.bodies.centring import BodyCentring
from objslam.live.bodies.description import BodyEstimator
from objslam.live.calibration.calibrator import Calibrator
from objslam.live.counters import Counters
from objslam.live.mapper.mapper import Mapper
from objslam.live.names.name_judge import NameJudge
from objslam.live.reassociation.reassociator import Reassociator
from objslam.live.rounds import Rounds
from objslam.live.session import low_latency
from objslam.live.session.finalize import finish
from objslam.live.session.frame_queue import FrameQueue
from objslam.live.session.intake import Intake
from objslam.live.session.map_locator import MapLocator
from objslam.live.session.snapshots import Describer, take_snapshot
from objslam.mapping.localization import PriorMap
from objslam.sources.journal.corrections import Correction
from objslam.sources.journal.journal import Journal
from objslam.sources.journal.reader import corrections, messages
from objslam.sources.journal.records import FrameMessage, Message, NoteMessage

_MOST_POSES = 20_000  # The most waiting messages except frames: 100 s of odometry at 200 Hz. A larger number costs memory.
_IDLE = 0.05
"""The longest sleep of the thread, s. If no frame came for this time, a requested snapshot is made. With a larger value,
snapshots come later."""
_SHORT = 0.015  # If the last messages took less than this, s, a snapshot follows at once. A larger value delays more frames.
_LONG = 0.5  # If a caller waits longer than this, s, a snapshot may delay frames. A larger value makes snapshots later.
_PATIENCE = 5.0  # The longest wait for a new snapshot, s. A larger value keeps the caller waiting longer.


class Session(Intake):
    """A `Sink` that builds a map. Call `start`, push from any thread, call `snapshot` at any time, and `stop` at the end.

    An error in the session's thread ends the session early. Then `failure` holds the error, every wait for the session ends,
    pushes are refused, and `stop` returns the result of the messages before the error.

    journal: the file that receives every accepted message before it is processed. Only one session may write the file.
    resume: whether to continue an existing journal. Then `start` processes its messages. patient: whether a push waits for
    the session, so that no frame is dropped because the session is slower than its source. known: a prior map. Once the
    session is found in it, snapshots and the result are in the frame of that map. A resumed session needs the same map
    again.
    """

    def __init__(
        self,
        settings: Settings,
        journal: Path | None = None,
        resume: bool = False,
        name: str = "live",
        patient: bool = False,
        known: PriorMap | None = None,
    ) -> None:
        super().__init__(settings, Counters(), self._enqueue)
        self._mapper = Mapper(settings, self.counters)
        of_session = settings, self.counters, self._mapper, self._record
        self._rounds: tuple[Rounds[Any, Any], ...] = (
            Calibrator(*of_session, name, patient),
            NameJudge(*of_session, name, patient),
            Reassociator(*of_session, name, patient),
            BodyCentring(*of_session, patient),
        )
        self._known, self._locator = known, MapLocator(known, self._mapper, self.counters)
        self._frames_waiting = FrameQueue(settings, self.counters, self._mapper, self._rounds, self._locator, patient)
        self._name, self._journal_file, self._resume, self._patient = name, journal, resume, patient
        live = settings.live
        self._journal = None
        if journal is not None:
            sizes = {"segment": round(1e6 * live.journal_segment_mb), "min_free": round(1e6 * live.journal_free_mb)}
            self._journal = Journal(journal, resume, **sizes, warn=self.counters.ledger.warn)
        if self._journal is not None and self._journal.torn:
            self.counters.drop("torn record at the end of the journal", f"{journal}, {self._journal.torn} bytes")
        self._queue: deque[tuple[Message, float]] = deque()
        self._taken: deque[tuple[Message, float]] = deque()
        self._frames = self._others = 0  # How many frames and how many other messages are in the queue.
        self._changed = threading.Condition()
        self._wanted = self._given = 0  # How many snapshots were requested, and how many requests were answered.
        self._busy = self._running = self._stopping = False
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="objslam session", daemon=True)
        self._bodies = BodyEstimator()
        self._describer = Describer(self._bodies)
        self._asked = -np.inf  # When the oldest unanswered request came, s (`time.perf_counter`).
        self._snapshot = Snapshot(np.nan, ObjectMap(()), Trajectory(np.zeros(0), np.zeros((0, 4, 4))))

    def start(self) -> Self:
        """Process the messages of the journal, then begin to take pushed messages."""
        import cv2  # noqa: F401 - imported here, so that the first frame does not wait for the import

        self._guard(self._replay_journal)
        if self.failure is None:
            self._running = True
            start_thread(self._thread)
        else:
            self._end()
        return self

    def snapshot(self) -> Snapshot:
        """Return the present map, or the last snapshot if the session has stopped or is busy for several seconds.

        The counts are always up to date. Even a stopped session refuses messages, and counts them.
        """
        found = self._present()
        return replace(found, counters=self.counters.accepted(), dropped=self.counters.dropped())

    def _present(self) -> Snapshot:
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
        """Wait until all pushed messages are processed, but at most `timeout`, s. Return whether they are processed.

        Return at once if the session ended early or was never started.
        """
        with self._changed:
            self._changed.wait_for(lambda: not (self._queue or self._busy) or not self._running, timeout)
            return not (self._queue or self._busy) and self.failure is None

    def stop(self) -> RunResult:
        """Process the pushed messages, end the thread, solve the whole map once more, and return the result.

        After a `failure`, the result covers the messages before it, and the ledger gets a warning. Raises the `failure` if
        no result can be made, and SolveError if no box could be mapped.
        """
        self._close()
        if self.failure is not None:
            reason = one_line(self.failure)
            self.counters.ledger.warn(f"the session ended early, the map covers the messages until then: {reason}")
        try:
            return finish(self._mapper.state, self._name, self._journal_file, self._known)
        except Exception as error:
            if self.failure is None:
                raise
            raise self.failure from error

    def abort(self) -> None:
        """End the thread and close the journal without a result."""
        self._close(discard=True)

    def _close(self, discard: bool = False) -> None:
        """End the thread, and then close the journal, because no push writes into it any more."""
        self.end()
        with self._changed:
            self._stopping = True
            if discard:
                self._queue.clear()
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        for each in self._rounds:
            each.close()
        self._bodies.close()
        if self._journal is not None:
            try:
                self._journal.close()
            except OutputError as error:  # the map matters more than the journal
                self.counters.ledger.warn(str(error))

    def _enqueue(self, message: Message, arrival: float) -> bool:
        """Put a message into the journal and the queue, or into neither. Return whether the message was accepted.

        A note, which stores the state of the clock and of the odometry's frame, only goes into the journal.
        """
        with self._changed:
            if self._patient:
                self._changed.wait_for(lambda: not (self._full() and self._running) or self._stopping)
            if self._stopping:
                self.counters.drop("messages after the end of the session")
                return False
            frame, note = isinstance(message, FrameMessage), isinstance(message, NoteMessage)
            if not frame and not note and self._others >= _MOST_POSES:
                self.counters.drop("poses refused because the queue was full")
                return False
            if self._journal is not None:
                try:
                    self._journal.write(message)
                except OutputError as error:  # The message is too long. A disk error is not raised, but ends the journal.
                    self.counters.drop(f"messages that could not be written to the journal: {error.message}")
                    return False
            if not note:
                self._queue.append((message, arrival))
                self._frames, self._others = self._frames + frame, self._others + (not frame)
                if self._frames > self._settings.live.max_frames_waiting:
                    self._drop_oldest_frame()
                self._changed.notify_all()
        return True

    def _full(self) -> bool:
        """Whether another message of some kind would push a frame out of the queue, or be refused."""
        return self._frames >= self._settings.live.max_frames_waiting or self._others >= _MOST_POSES

    def _record(self, message: Correction) -> bool:
        """Write a correction into the journal, and return whether the session may use it."""
        with self._changed:
            try:
                if self._journal is not None:
                    self._journal.write(message)
            except OutputError as error:
                self.counters.drop(f"corrections of the map that could not be written to the journal: {error.message}")
                return False
        return True

    def _drop_oldest_frame(self) -> None:
        for i, (message, _) in enumerate(self._queue):
            if isinstance(message, FrameMessage):
                del self._queue[i]
                self._frames -= 1
                self.counters.drop_frame(message, TOO_SLOW)
                return

    def _replay_journal(self) -> None:
        if not self._journal_file or not self._resume:
            return
        known = corrections(self._journal_file)
        for each in self._rounds:
            each.expect(known)
        for message in messages(self._journal_file, self.counters.ledger):
            if not isinstance(message, Correction):
                self.recall(message)
                self._frames_waiting.take(message, time.perf_counter(), measured=False)
        for each in self._rounds:
            each.begin()

    def _work(self) -> None:
        self._guard(self._serve)
        self._end()

    def _serve(self) -> None:
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
            if self._has_time(worked, begin) and not self._answer():
                low_latency.collect_early()

    def _guard(self, work: Callable[[], object]) -> None:
        """Call `work`, and keep its error as the session's `failure`, unless an earlier failure is kept."""
        try:
            work()
        except Exception as error:  # noqa: BLE001 - `failure` reports it, because nothing catches what a thread raises
            self.failure = self.failure or error

    def _end(self) -> None:
        """Make the last snapshot, drop and count the messages that remain, and wake all waiting threads."""
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

    def _idle(self) -> float:
        """Return how long the thread may sleep without a message, s."""
        return _IDLE if self._wanted == self._given else max(0.0, self._frames_waiting.worked + _IDLE - time.perf_counter())

    def _has_time(self, worked: bool, begin: float) -> bool:
        """Return whether to make a snapshot now. The time is right if no frame came for a while, if the last messages were
        quick, or if the caller has waited for long.

        worked: whether a frame was just processed. begin: when the last messages were taken, s (`time.perf_counter`).
        """
        now = time.perf_counter()
        return now - self._frames_waiting.worked > _IDLE or (worked and (now - begin < _SHORT or now - self._asked > _LONG))

    def _answer(self) -> bool:
        """Make the requested snapshot, and return whether a snapshot was requested."""
        wanted = self._wanted
        if wanted == self._given and not self._stopping:
            return False
        snapshot = take_snapshot(self._mapper.state, self._describer, self._frames_waiting.lag, whole=self._stopping)
        snapshot = self._locator.in_map(snapshot)
        with self._changed:
            self._snapshot, self._given = snapshot, wanted
            self._changed.notify_all()
        return True
