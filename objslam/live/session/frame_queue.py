"""The queue of frames. Frames wait until the path covers them, and are then mapped in the order of their stamps."""

import bisect
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from objslam.config import Settings
from objslam.core.snapshot import RARE_POSES, TOO_SLOW
from objslam.live.counters import Counters
from objslam.live.mapper.mapper import Mapper
from objslam.live.rounds import Rounds
from objslam.live.session.map_locator import MapLocator
from objslam.sources.journal.records import FrameMessage, Message

_NEVER_COVERED = "frames that the path never covered"


class FrameQueue:
    """Passes messages to the mapper. patient: whether frames may wait for their poses without a limit.

    lag: the time, s, from the arrival of the last mapped frame until the map contained it. worked: the time, s, by
    `time.perf_counter`, when a frame last left the queue.
    """

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        rounds: Sequence[Rounds[Any, Any]],
        locator: MapLocator,
        patient: bool,
    ) -> None:
        self._limit, self._most = settings.live.max_lag, settings.live.max_frames_waiting
        self._counters, self._mapper, self._patient = counters, mapper, patient
        self._rounds, self._locator = rounds, locator
        # For each frame: the corrected stamp, s, its number in the order of arrival, the message, the time of arrival, s.
        self._waiting: list[tuple[float, int, FrameMessage, float]] = []
        self._frames = 0
        self._newest = -np.inf  # The latest arrival of a message, s. The message taken last may have arrived earlier.
        self.lag = 0.0
        self.worked = -np.inf

    def take(self, message: Message, arrival: float, measured: bool = True) -> bool:
        """Take a message, and return whether any frame left the queue. arrival: the time of its arrival, s, by
        `time.perf_counter`.

        measured: whether the time until the map contains a frame is limited and counted. False for a journal.
        """
        self._newest = max(self._newest, arrival)
        if isinstance(message, FrameMessage):
            self._frames += 1
            bisect.insort(self._waiting, (self._mapper.corrected_stamp(message), self._frames, message, arrival))
            while len(self._waiting) > self._most:
                self._counters.drop_frame(self._waiting.pop(0)[2], _NEVER_COVERED)
        else:
            self._mapper.feed(message)
        worked = False
        while self._waiting and self._mapper.is_ready(self._waiting[0][0]):
            worked = True
            stamp, _, frame, came = self._waiting.pop(0)
            # If a camera's clock is behind, its frames have to wait longer for their poses, so their limit is longer.
            limit = self._limit + max(0.0, stamp - frame.stamp)
            if measured and not self._patient and time.perf_counter() - came > limit:
                self._counters.drop_frame(frame, RARE_POSES if self._newest - came > limit else TOO_SLOW)
                continue
            update = self._mapper.take(frame)
            if update is not None:
                self.lag = time.perf_counter() - came
                if measured:
                    self._counters.updated(self.lag)
                self._mapper.look_after(update)
                self._locator.after_keyframe()
                corrections = [each.after_keyframe() for each in self._rounds]
                if any(corrections):
                    corrected = self._mapper.corrected_stamp
                    self._waiting = sorted((corrected(f), number, f, arrived) for _, number, f, arrived in self._waiting)
        if worked:
            self.worked = time.perf_counter()
        return worked
