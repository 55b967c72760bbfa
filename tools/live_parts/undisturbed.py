"""The lag of a session's frames on a machine that does nothing else, from the CPU time of the session's thread."""

from __future__ import annotations

import time

from objslam.live.mapper.landmark_update import LandmarkUpdate
from objslam.live.session.session import Session
from objslam.sources.journal.records import FrameMessage, Message


class Undisturbed:
    """Computes when a session would have mapped each frame, if every message came at its stamp and its thread had a core of
    its own.

    On a busy machine, other processes make frames wait. They hardly change the CPU time of the thread. A message waits until
    the thread is done with the messages before it, and with all work after them: maintenance, corrections and snapshots.
    """

    def __init__(self, session: Session) -> None:
        """Watch a session that has not started."""
        self.lags: list[float] = []
        """The times, s, from the stamp of each keyframe until the map contains it."""
        self._began: float | None = None  # The CPU time of the thread when it took the present message, s.
        self._start = 0.0  # When that would have been, in stamps, s.
        self._take_message, self._take_frame = session._frames_waiting.take, session._mapper.take
        session._frames_waiting.take = self._message  # type: ignore[method-assign]
        session._mapper.take = self._frame  # type: ignore[method-assign]

    def _message(self, message: Message, arrival: float, measured: bool = True) -> bool:
        now, stamp = time.thread_time(), getattr(message, "stamp", None)
        free = -float("inf") if self._began is None else self._start + now - self._began
        self._began, self._start = now, free if stamp is None else max(free, stamp)
        return self._take_message(message, arrival, measured)

    def _frame(self, frame: FrameMessage) -> LandmarkUpdate | None:
        update = self._take_frame(frame)
        if update is not None and self._began is not None:
            self.lags.append(self._start + time.thread_time() - self._began - frame.stamp)
        return update
