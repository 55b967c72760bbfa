"""A detector in its own thread, which always processes the newest image of each topic."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from objslam.errors import ObjslamError, first_line
from objslam.io.threads import start_thread
from objslam.live.ros.boxes import Boxes, Drop
from objslam.ros.bag.records import frame_name
from objslam.ros.messages.decode import DecodeError
from objslam.ros.messages.images import colour_image

if TYPE_CHECKING:
    from objslam.detection import Detector

_MAX_TOPICS = 64  # The most topics with a waiting image. A larger number costs memory.
_IN_A_ROW = 5  # The number of consecutive failed images of a topic before a warning. A larger number warns later.
_FAILED, _ENDED = "image that the detector failed on", "image that arrived after the detector had ended"


class DetectorWorker:
    """Runs a detector on offered images, and delivers the boxes.

    For each topic, only the newest image waits. The topics take turns.
    """

    def __init__(self, detector: Detector, clock: Callable[[], float] = time.monotonic) -> None:
        self._detector, self._clock = detector, clock
        self._waiting: dict[str, tuple[Any, float]] = {}
        self._ready = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = self._ended = False
        self._in_a_row: Counter[str] = Counter()
        self._warned: set[str] = set()

    def start(self, deliver: Callable[[Boxes], None], drop: Drop, warn: Callable[[str], None]) -> None:
        """Start the detector's thread. It calls deliver(boxes), warn(message) and drop(reason, place)."""
        self._deliver, self._drop, self._warn = deliver, drop, warn
        self._thread = threading.Thread(target=self._work, name="detector", daemon=True)
        start_thread(self._thread)

    def offer(self, topic: str, message: Any, stamp: float) -> None:
        """Take an image message without blocking. stamp: s."""
        with self._ready:
            ended = self._ended
            # The newer image takes the older image's place in the queue. If it went to the end, it might never be next.
            late = self._waiting.get(topic)
            full = late is None and len(self._waiting) >= _MAX_TOPICS
            if not full and not ended:
                self._waiting[topic] = message, stamp
                self._ready.notify()
        if ended:
            self._drop(_ENDED, f"{topic} at {stamp:.3f} s")
        elif late is not None:
            self._drop("image replaced by a newer one before the detector was free", f"{topic} at {late[1]:.3f} s")
        elif full:
            self._drop(f"image of a topic beyond the first {_MAX_TOPICS}", topic)

    def close(self) -> None:
        """End the thread after the image that it now processes."""
        with self._ready:
            self._closed = True
            self._ready.notify()
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        try:
            while (waiting := self._next()) is not None:
                self._look(*waiting)
        except BaseException as error:  # noqa: BLE001 - the warning reports it, because nothing catches what a thread raises
            with self._ready:
                self._ended = True
                left, self._waiting = self._waiting, {}
            self._warn(f"the detector has ended, later images are dropped: {_one_line(error)}")
            for topic, (_, stamp) in left.items():
                self._drop(_ENDED, f"{topic} at {stamp:.3f} s")

    def _next(self) -> tuple[str, Any, float] | None:
        with self._ready:
            self._ready.wait_for(lambda: self._waiting or self._closed)
            if self._closed:
                return None
            topic = next(iter(self._waiting))
            return topic, *self._waiting.pop(topic)

    def _look(self, topic: str, message: Any, stamp: float) -> None:
        reason = _FAILED
        try:
            image = colour_image(message)
            found = self._detector.detect([image])[0]
            size, frame = (image.shape[1], image.shape[0]), frame_name(message.header.frame_id)
            what = found.boxes, found.labels, found.scores
            boxes = Boxes(topic, stamp, frame, self._clock(), *what, size=size, image=image)
            reason = "image whose boxes could not be handed on"
            self._deliver(boxes)
        except DecodeError as error:
            self._fail("image that cannot be decoded", topic, stamp, error)
        except BaseException as error:
            self._fail(reason, topic, stamp, error)
            if not isinstance(error, Exception):
                raise
        else:
            self._in_a_row.pop(topic, None)

    def _fail(self, reason: str, topic: str, stamp: float, error: BaseException) -> None:
        """Count a failed image, and warn once per topic when several fail in a row."""
        why = _one_line(error)
        self._drop(reason, f"{topic} at {stamp:.3f} s: {why}")
        self._in_a_row[topic] += 1
        if self._in_a_row[topic] == _IN_A_ROW and topic not in self._warned:
            self._warned.add(topic)
            self._warn(
                f"{topic}: the detector gave no boxes for {_IN_A_ROW} images in a row, the last at {stamp:.3f} s: {why}"
            )


def _one_line(error: BaseException) -> str:
    """Return the message of an error, with its type unless the error is from objslam."""
    if isinstance(error, (ObjslamError, DecodeError)):
        return first_line(error)
    kind = type(error).__name__
    return f"{kind}: {first_line(error)}" if str(error).strip() else kind
