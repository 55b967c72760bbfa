"""Adapters, a file each: what brings messages to a session. run(stop) returns when stop is set, or all has been read.

`ADAPTERS` is the table of them for `objslam live SOURCE`: a new one is one more file, one more row here, and a function that
makes it. What is not in the table is a recording, which is replayed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from objslam.ledger import Ledger
from objslam.live.interface import Sink, Snapshot
from objslam.sources import SourceOptions

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.live.ros_messages import RosMessages
    from objslam.live.topic_choice import TopicChoice


class Adapter(Protocol):
    """What brings messages."""

    @property
    def ledger(self) -> Ledger:
        """What was dropped before it could be pushed, and warnings."""
        ...

    def run(self, stop: threading.Event) -> None:
        """Push messages until stop is set, or there are no more."""
        ...


@dataclass(frozen=True)
class LiveOptions:
    """What the command line says. source: as for a recording. domain, interface: of DDS (see `dds_network`)."""

    settings: Settings
    detector: Path | None = None
    source: SourceOptions = field(default_factory=SourceOptions)
    domain: int | None = None
    interface: str | None = None


@dataclass(frozen=True)
class Feed:
    """An adapter, what else wants to see the snapshots, and what to close in the end.

    image: the image of a camera, by its name, at a stamp, s, where the adapter sees any.
    """

    adapter: Adapter
    views: tuple[Callable[[Snapshot], object], ...] = ()
    close: tuple[Callable[[], None], ...] = ()
    image: Callable[[str, float], NDArray[np.uint8] | None] | None = None


def _stdin(sink: Sink, options: LiveOptions) -> Feed:
    import sys

    from objslam.live.adapters.stdin import StdinAdapter

    return Feed(StdinAdapter(sink, sys.stdin.buffer))


def _dds(sink: Sink, options: LiveOptions) -> Feed:
    from objslam.live.adapters.dds import DdsAdapter
    from objslam.live.dds_network import open_network

    network = open_network(options.domain, options.interface)
    messages, choice, close = _ros(sink, options)
    return Feed(DdsAdapter(network, messages, choice), close=close, image=messages.image)


def _rclpy(sink: Sink, options: LiveOptions) -> Feed:
    from objslam.live.adapters.rclpy import RclpyAdapter

    messages, choice, close = _ros(sink, options)
    return Feed(RclpyAdapter(messages, choice), close=close, image=messages.image)


def _ros(sink: Sink, options: LiveOptions) -> tuple[RosMessages, TopicChoice, tuple[Callable[[], None], ...]]:
    """What turns ROS messages into pushes, which topics it wants, and what to close in the end."""
    from objslam.live.detector_worker import DetectorWorker
    from objslam.live.ros_messages import RosMessages, RosOptions, parse_topics
    from objslam.live.topic_choice import TopicChoice
    from objslam.sources.camera_file import read_calibrations

    source, ledger = options.source, Ledger()
    topics = parse_topics(source.topics)
    calibrations = read_calibrations(source.camera_info, ledger) if source.camera_info is not None else ()
    worker = None
    if options.detector is not None:
        from objslam.detection import load_detector

        detector = load_detector(options.detector, options.settings.detector)
        for warning in detector.warnings:
            ledger.warn(warning)
        worker = DetectorWorker(detector)
    said = RosOptions(topics, source.base_frame, calibrations, source.rectified, source.label or "")
    messages = RosMessages(sink, said, worker, ledger=ledger)
    return messages, TopicChoice(topics, worker is not None), (worker.close,) if worker is not None else ()


ADAPTERS: dict[str, Callable[[Sink, LiveOptions], Feed]] = {
    "dds": _dds,
    "rclpy": _rclpy,
    "stdin": _stdin,
}
"""What makes the adapter that a name of `objslam live` stands for."""
