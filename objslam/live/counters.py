"""Counters of a session: accepted messages, dropped messages by reason, and the duration of map updates."""

import threading
from collections import Counter, deque

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.sources.journal.records import FrameMessage

_WINDOW = 2000  # The number of newest update times in `Counters.update`. With a larger number, its result reacts later.


class _Guarded(Ledger):
    """A ledger into which several threads may write at the same time."""

    def __init__(self, lock: threading.RLock) -> None:
        super().__init__()
        self._lock = lock

    def drop(self, reason: str, count: int = 1, where: str | None = None, of: int | None = None) -> None:
        with self._lock:
            super().drop(reason, count, where, of)

    def warn(self, message: str) -> None:
        with self._lock:
            super().warn(message)


class Counters:
    """Counters that any thread may change. `ledger` holds the drops, with the first few places of each reason."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._accepted: Counter[str] = Counter()
        self._seconds: deque[float] = deque(maxlen=_WINDOW)
        self.ledger: Ledger = _Guarded(self._lock)

    def accept(self, kind: str, count: int = 1) -> None:
        """Count accepted messages or events of a kind."""
        with self._lock:
            self._accepted[kind] += count

    def drop(self, reason: str, where: str | None = None, count: int = 1) -> None:
        """Count messages that are dropped for a reason. where: the place of the first one, for reports."""
        self.ledger.drop(reason, count, where)

    def drop_frame(self, frame: FrameMessage, reason: str) -> None:
        """Count a dropped frame under `reason`, and its boxes under the same text with "boxes" in place of "frames"."""
        self.drop(reason, f"camera {frame.camera}, stamp {frame.stamp:.3f}")
        self.drop(reason.replace("frames", "boxes", 1), count=len(frame))

    def updated(self, seconds: float) -> None:
        """Record the time, s, from the push of a frame until the map contains it."""
        with self._lock:
            self._seconds.append(seconds)

    def accepted(self) -> dict[str, int]:
        """Return the number of accepted messages and events by kind."""
        with self._lock:
            return dict(self._accepted)

    def dropped(self) -> dict[str, int]:
        """Return the number of dropped messages by reason."""
        with self._lock:
            return dict(self.ledger.dropped)

    def update(self) -> tuple[float, float]:
        """Return the median and the 99th percentile of the newest update times, s. Both are 0 before the first update."""
        with self._lock:
            seconds = np.array(self._seconds)
        return (float(np.median(seconds)), float(np.quantile(seconds, 0.99))) if len(seconds) else (0.0, 0.0)
