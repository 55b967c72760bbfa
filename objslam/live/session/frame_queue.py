"""The queue of frames that wait until the path covers them, and then enter the map in the order of their stamps."""

import bisect
import time

import numpy as np

from objslam.config import Settings
from objslam.live.counters import Counters
from objslam.live.mapper.mapper import Mapper
from objslam.sources.journal.records import FrameMessage, Message

TOO_SLOW = "frames that waited too long (live.max_lag)"  # The reason for dropping a frame that the session had no time for.
_RARE_POSES = "frames whose pose came more than live.max_lag later: poses are too rare or late, or live.max_lag is too short"
_NEVER_COVERED = "frames that the path never covered"


class FrameQueue:
    """Feeds messages to the mapper. patient: whether frames of any age are accepted.

    lag: time, s, from the arrival of the newest frame until the map contains it. worked: when the last frame was processed,
    s, by `time.perf_counter`.
    """

    def __init__(self, settings: Settings, counters: Counters, mapper: Mapper, patient: bool) -> None:
        self._limit, self._most = settings.live.max_lag, settings.live.max_frames_waiting
        self._counters, self._mapper, self._patient = counters, mapper, patient
        self._waiting: list[tuple[float, int, FrameMessage, float]] = []  # stamp, order of arrival, frame, arrival
        self._frames = 0
        self.lag = 0.0
        self.worked = -np.inf

    def take(self, message: Message, arrival: float, measured: bool = True) -> bool:
        """Take a message that arrived at a time, s, and return whether any frame left the queue.

        measured: whether the lag is recorded and limited. It is not for a message of a journal.
        """
        if isinstance(message, FrameMessage):
            self._frames += 1
            bisect.insort(self._waiting, (message.stamp, self._frames, message, arrival))
            while len(self._waiting) > self._most:
                self._counters.drop_frame(self._waiting.pop(0)[2], _NEVER_COVERED)
        else:
            self._mapper.feed(message)
        worked = False
        while self._waiting and self._mapper.is_ready(self._waiting[0][0]):
            worked = True
            _, _, frame, came = self._waiting.pop(0)
            if measured and not self._patient and time.perf_counter() - came > self._limit:
                self._counters.drop_frame(frame, _RARE_POSES if arrival - came > self._limit else TOO_SLOW)
                continue
            update = self._mapper.take(frame)
            if update is not None:
                self.lag = time.perf_counter() - came
                if measured:
                    self._counters.updated(self.lag)
                self._mapper.look_after(update)
        if worked:
            self.worked = time.perf_counter()
        return worked
