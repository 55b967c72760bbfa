"""Adapters bring messages to a session, one file per adapter. `ADAPTERS` lists them for `objslam live SOURCE`.

A new adapter needs a file, a row in `ADAPTERS` and a function that makes it. `LiveOptions` must inherit the class of its
options. A SOURCE that is not in the table is a recording. `--help` imports this module, so it imports no heavy library.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from objslam.core.diagnostics import Ledger
from objslam.errors import ObjslamError
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

ODOM = "odom"  # The name of the odometry's frame where messages do not name it (REP 105).
_INTERFACE = "DDS: a network interface, by name or address, or auto for any. Default: from CYCLONEDDS_URI, else loopback."


Wait = Callable[[], object]
"""A function that returns once the map contains all messages that were pushed."""


class Adapter(Protocol):
    """Brings messages to a `Sink`."""

    @property
    def ledger(self) -> Ledger:
        """The warnings, and the counts of messages that were dropped before a push."""

    def run(self, stop: threading.Event) -> None:
        """Push messages until `stop` is set or the source ends."""


@dataclass(frozen=True)
class LiveRosOptions(RosOptions):
    """Facts that the messages of a running robot lack, and the detector for its images, if any."""

    detector: Annotated[Path | None, DETECTOR] = None


@dataclass(frozen=True)
class NetworkOptions:
    """The arguments of `live.dds.network.open_network`."""

    domain: Annotated[int | None, Option("--domain", "DDS domain. Default: ROS_DOMAIN_ID, else 0.")] = None
    interface: Annotated[str | None, Option("--interface", _INTERFACE)] = None


@dataclass(frozen=True)
class DdsOptions(NetworkOptions, LiveRosOptions):
    """The options of the DDS adapter, for its ROS messages and for its network."""


@dataclass(frozen=True)
class LiveOptions(DdsOptions, SourceOptions):
    """The options of all adapters, and of the recordings that may be replayed instead."""


@dataclass(frozen=True)
class Feed:
    """An adapter, with functions that the session calls for it.

    views: functions that receive every snapshot. close: functions that are called at the end. ticks: functions that are
    called ten times a second. image: returns the image of a camera, given the camera's name and a stamp, s. The function is
    None if the adapter has no images. odom_frame: returns the name of the odometry's frame, or None if --publish-tf must not
    publish the pose of this frame. late: returns advice to the user for the case that frames came too late for the map. The
    advice is "" if the source has none.
    """

    adapter: Adapter
    views: tuple[Callable[[Snapshot], object], ...] = ()
    close: tuple[Callable[[], None], ...] = ()
    image: Callable[[str, float], NDArray[np.uint8] | None] | None = None
    odom_frame: Callable[[], str | None] = lambda: ODOM
    ticks: tuple[Callable[[], object], ...] = ()
    late: Callable[[], str] = str


@dataclass(frozen=True)
class LiveSource:
    """A named source of `objslam live`.

    says: its description in `--help`. opens: the function that makes its `Feed`. options: the class of its options, which
    `LiveOptions` inherits, or None if the source has no options. recorded: a function that returns whether the messages now
    come from a recording. Recorded messages may be read as fast as they are mapped (--speed 0). The function is None if the
    messages never come from a recording.
    """

    says: str
    opens: Callable[[Sink, Settings, LiveOptions, Wait | None], Feed]
    options: type[Any] | None = None
    recorded: Callable[[], bool] | None = None


def _stdin(sink: Sink, settings: Settings, options: object, wait: Wait | None) -> Feed:
    import sys

    from objslam.live.adapters.stdin import StdinAdapter

    if sys.stdin is None:
        raise ObjslamError("standard input is closed", hint="pipe JSON lines into it, or give a file: < messages.jsonl")
    adapter = StdinAdapter(sink, sys.stdin.buffer, wait=wait)
    return Feed(adapter, late=adapter.late)


def _is_file() -> bool:
    """Return whether standard input is a file, which no running robot writes."""
    import os
    import stat
    import sys

    return sys.stdin is not None and stat.S_ISREG(os.fstat(sys.stdin.fileno()).st_mode)


def _dds(sink: Sink, settings: Settings, options: DdsOptions, wait: Wait | None) -> Feed:
    from objslam.live.adapters.dds import DdsAdapter
    from objslam.live.dds.network import open_network

    return _ros(sink, settings, options, partial(DdsAdapter, open_network(options.domain, options.interface)))


def _rclpy(sink: Sink, settings: Settings, options: LiveRosOptions, wait: Wait | None) -> Feed:
    from objslam.live.adapters.rclpy import RclpyAdapter

    return _ros(sink, settings, options, RclpyAdapter)


def _ros(
    sink: Sink, settings: Settings, options: LiveRosOptions, make: Callable[[RosMessages, TopicChoice], Adapter]
) -> Feed:
    """Return the feed of an adapter for ROS messages, with a detector if the options name one. make: makes the adapter."""
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
    adapter = make(messages, TopicChoice(messages.chosen, worker is not None))
    return Feed(
        adapter, close=(worker.close,) if worker is not None else (), image=messages.image, odom_frame=messages.odom_frame
    )


ADAPTERS = {
    "dds": LiveSource("a ROS 2 robot", _dds, DdsOptions),
    "rclpy": LiveSource("a ROS 2 robot, through a ROS node", _rclpy, LiveRosOptions),
    "stdin": LiveSource("JSON lines", _stdin, recorded=_is_file),
}
"""The sources of `objslam live` by name."""
