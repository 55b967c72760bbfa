"""Replaces the class numbers of a running robot's boxes by names, before the session receives the boxes."""

from collections import Counter
from collections.abc import Sequence

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.frontend.class_names import load_names, named
from objslam.live.counters import Counters
from objslam.live.interface import Sink

UNNAMED = "boxes with a class number that has no name"
"""The name of the event that is counted for each box whose label stays a number."""


class NamedSink:
    """A `Sink` that hands all messages to another sink, with names in place of labels that are numbers.

    sink: the other sink. given: the names, as `load_names` takes them. counters: counts the boxes whose number has no name.
    The user is warned of the first such box. Raises ConfigError as `load_names` does.
    """

    def __init__(self, sink: Sink, given: str, counters: Counters) -> None:
        self._sink, self._given, self._names, self._counters = sink, given, load_names(given), counters
        self._warned = False

    def push_camera(self, camera: Camera) -> bool:
        """Push a camera, as `Sink.push_camera`."""
        return self._sink.push_camera(camera)

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push odometry, as `Sink.push_odometry`."""
        return self._sink.push_odometry(stamp, odom_T_base, covariance)

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push a localisation, as `Sink.push_localization`."""
        return self._sink.push_localization(stamp, map_T_base, covariance)

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """Push a mount, as `Sink.push_mount`."""
        return self._sink.push_mount(stamp, camera, base_T_camera)

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
        """Push boxes with their names, as `Sink.push_detections`."""
        if not isinstance(labels, list | tuple):  # The session refuses these.
            return self._sink.push_detections(stamp, camera, boxes, labels, scores, depths, track_ids, whole)
        found = [named(label, self._names) if isinstance(label, str) else label for label in labels]
        unnamed = Counter(label for label, name in zip(labels, found, strict=True) if name is None is not label)
        if unnamed:
            self._counters.accept(UNNAMED, unnamed.total())
            if not self._warned:
                self._warned = True
                self._counters.ledger.warn(
                    f"{self._given} does not name class {next(iter(unnamed))}: such boxes keep their number"
                )
        kept = [label if name is None else name for label, name in zip(labels, found, strict=True)]
        return self._sink.push_detections(stamp, camera, boxes, kept, scores, depths, track_ids, whole)
