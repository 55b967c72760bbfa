"""Adapters, a file each: what brings messages to a session. run(stop) returns when stop is set, or all has been read.

`ADAPTERS` is the table of them for `objslam live SOURCE`: a new one is one more file, one more row here, and a function that
makes it; if it has options, `LiveOptions` inherits them. What is not in the table is a recording, which is replayed. What is
imported here may not be heavy: the command line reads the table before it answers `--help`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from objslam.core.diagnostics import Ledger
from objslam.sources import SourceOptions
from objslam.sources.options import DETECTOR, Option
from objslam.sources.ros_bag.options import RosOptions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from objslam.config import Settings
    from objslam.core.snapshot import Snapshot
    from objslam.live.interface import Sink
    from objslam.live.ros.message_handler import RosMessages
    from objslam.live.ros.topic_discovery import TopicChoice


_INTERFACE = "DDS: auto, or a network interface's name or address. [default: as CYCLONEDDS_URI says, else loopback]"


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
class LiveRosOptions(RosOptions):
    """What a running robot's messages do not say themselves, and the model that finds the boxes in its images, if any."""

    detector: Annotated[Path | None, DETECTOR] = None


@dataclass(frozen=True)
class NetworkOptions:
    """Where DDS is; see `live.dds.network`."""

    domain: Annotated[int | None, Option("--domain", "DDS domain. [default: ROS_DOMAIN_ID, else 0]")] = None
    interface: Annotated[str | None, Option("--interface", _INTERFACE)] = None


@dataclass(frozen=True)
class DdsOptions(NetworkOptions, LiveRosOptions):
    """What is heard over DDS does not say itself, and where that is."""


@dataclass(frozen=True)
class LiveOptions(DdsOptions, SourceOptions):
    """All options of all adapters, and of the recordings that may be replayed in their place."""


@dataclass(frozen=True)
class Feed:
    """An adapter, what else wants to see the snapshots, and what to close in the end.

    image: the image of a camera, by its name, at a stamp, s, where the adapter sees any.
    """

    adapter: Adapter
    views: tuple[Callable[[Snapshot], object], ...] = ()
    close: tuple[Callable[[], None], ...] = ()
    image: Callable[[str, float], NDArray[np.uint8] | None] | None = None


@dataclass(frozen=True)
class LiveSource:
    """What `objslam live` calls by a name.

    Attributes:
        says: what it is, in a few words for `--help`.
        opens: what makes its adapter.
        options: the class of the options that it takes, which `LiveOptions` inherits; None: it takes none.
    """

    says: str
    opens: Callable[[Sink, Settings, LiveOptions], Feed]
    options: type[Any] | None = None


def _stdin(sink: Sink, settings: Settings, options: object) -> Feed:
    import sys

    from objslam.live.adapters.stdin import StdinAdapter

    return Feed(StdinAdapter(sink, sys.stdin.buffer))


def _dds(sink: Sink, settings: Settings, options: DdsOptions) -> Feed:
    from objslam.live.adapters.dds import DdsAdapter
    from objslam.live.dds.network import open_network

    network = open_network(options.domain, options.interface)
    messages, choice, close = _ros(sink, settings, options)
    return Feed(DdsAdapter(network, messages, choice), close=close, image=messages.image)


def _rclpy(sink: Sink, settings: Settings, options: LiveRosOptions) -> Feed:
    from objslam.live.adapters.rclpy import RclpyAdapter

    messages, choice, close = _ros(sink, settings, options)
    return Feed(RclpyAdapter(messages, choice), close=close, image=messages.image)


def _ros(
    sink: Sink, settings: Settings, options: LiveRosOptions
) -> tuple[RosMessages, TopicChoice, tuple[Callable[[], None], ...]]:
    """What turns ROS messages into pushes, which topics it wants, and what to close in the end."""
    from objslam.live.ros.detector_worker import DetectorWorker
    from objslam.live.ros.message_handler import RosMessages
    from objslam.live.ros.topic_discovery import TopicChoice

    worker, ledger = None, Ledger()
    if options.detector is not None:
        from objslam.detection import load_detector

        detector = load_detector(options.detector, settings.detector)
        for warning in detector.warnings:
            ledger.warn(warning)
        worker = DetectorWorker(detector)
    messages = RosMessages(sink, options, worker, ledger=ledger)
    return messages, TopicChoice(messages.chosen, worker is not None), (worker.close,) if worker is not None else ()


ADAPTERS = {
    "dds": LiveSource("a ROS 2 robot", _dds, DdsOptions),
    "rclpy": LiveSource("the same, as a ROS node", _rclpy, LiveRosOptions),
    "stdin": LiveSource("JSON lines", _stdin),
}
"""What a name of `objslam live` stands for."""
