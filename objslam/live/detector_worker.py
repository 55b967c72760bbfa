"""A detector on live images, in a thread of its own: the newest image of each topic counts, older ones are dropped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from objslam.errors import DetectorError
from objslam.live.frames import Boxes, Drop
from objslam.sources.ros.decode import Undecodable
from objslam.sources.ros.images import colour_image
from objslam.sources.ros.records import frame_name

if TYPE_CHECKING:
    from objslam.detection import Detector

_MAX_TOPICS = 64


class DetectorWorker:
    """Runs a detector on the images that are offered and hands on what it finds.

    One image a topic waits at a time; a newer one takes its place, so boxes are never older than one detection takes for
    each topic. What is dropped is counted.
    """

    def __init__(self, detector: Detector, clock: Callable[[], float] = time.monotonic) -> None:
        self._detector, self._clock = detector, clock
        self._waiting: dict[str, tuple[Any, float]] = {}
        self._ready = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = False

    def start(self, deliver: Callable[[Boxes], None], drop: Drop) -> None:
        """Begin to work: deliver gets the boxes, drop what was dropped and why; both are called from other threads too."""
        self._deliver, self._drop = deliver, drop
        self._thread = threading.Thread(target=self._work, name="detector", daemon=True)
        self._thread.start()

    def offer(self, topic: str, message: Any, stamp: float) -> None:
        """Take an image message; returns at once."""
        with self._ready:
            late = self._waiting.pop(topic, None)
            full = late is None and len(self._waiting) >= _MAX_TOPICS
            if not full:
                self._waiting[topic] = message, stamp
                self._ready.notify()
        if late is not None:
            self._drop("image that a newer one overtook before the detector had time for it", f"{topic} at {late[1]:.3f} s")
        if full:
            self._drop(f"image of a topic beyond the first {_MAX_TOPICS}", topic)

    def close(self) -> None:
        """End the thread, after the image that it is at."""
        with self._ready:
            self._closed = True
            self._ready.notify()
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                topic = next(iter(self._waiting))
                message, stamp = self._waiting.pop(topic)
            place = f"{topic} at {stamp:.3f} s"
            try:
                image = colour_image(message)
                found = self._detector.detect([image])[0]
            except Undecodable as error:
                self._drop("image that cannot be decoded", f"{place}: {error}")
            except DetectorError as error:
                self._drop("image that the detector failed on", f"{place}: {error}")
            else:
                size, frame = (image.shape[1], image.shape[0]), frame_name(message.header.frame_id)
                what = found.boxes, found.labels, found.scores
                self._deliver(Boxes(topic, stamp, frame, self._clock(), *what, size=size, image=image))
