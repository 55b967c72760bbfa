"""Receives the messages of a ROS 2 robot as a ROS node, which needs an installed and sourced ROS 2."""

import threading
import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from objslam.errors import ObjslamError
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import HEAD_START, LONELY, LOOK_EVERY, QUEUE, STOP_WAIT, TopicChoice
from objslam.ros.messages.topic_types import IMAGES, LATCHED

_Kind = tuple[bool, bool]  # A QoS: whether it is reliable, and whether it is transient-local.


@dataclass
class RclpyAdapter:
    """Subscribes to the topics of the wanted types, while publishers come and go. Raises ObjslamError without rclpy.

    ROS does not name the publisher of a message, so each topic has one subscription. It is reliable if all publishers are
    reliable. Else it is best-effort, because such a subscription receives from all publishers.
    """

    messages: RosMessages
    choice: TopicChoice
    _open: dict[str, tuple[Any, _Kind]] = field(default_factory=dict)
    _unknown: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        try:
            import rclpy  # noqa: F401
        except ImportError as error:
            hint = "source the setup of ROS 2 with its own Python, or use `objslam live dds`, which needs no ROS"
            raise ObjslamError(f"rclpy cannot be imported ({error})", hint=hint) from error
        self.ledger = self.messages.ledger

    def run(self, stop: threading.Event) -> None:
        """Push messages until `stop` is set."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = rclpy.create_node("objslam", context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            begin, looked = time.monotonic(), 0.0
            while not stop.is_set():
                executor.spin_once(timeout_sec=STOP_WAIT)
                now = time.monotonic()
                if now - looked >= LOOK_EVERY:
                    looked = now
                    self._look_around(node, now - begin)
                    self.messages.tick()
            executor.shutdown()
            node.destroy_node()
        finally:
            rclpy.shutdown(context=context)

    def _look_around(self, node: Any, age: float) -> None:
        """Subscribe to the wanted topics. Subscribe again if the QoS of their publishers has changed.

        age: the time since the start, s.
        """
        offered = {name: types[0] for name, types in node.get_topic_names_and_types() if types}
        for topic in sorted(self.choice.wanted(offered, self.messages, settled=age >= HEAD_START)):
            type_ = offered[topic]
            profiles = [publisher.qos_profile for publisher in node.get_publishers_info_by_topic(topic)]
            if not profiles or type_ in self._unknown:
                continue
            kind = _kind(profiles, type_)
            old, old_kind = self._open.get(topic, (None, None))
            message = self._message(type_) if old_kind != kind else None
            if message is None:
                continue
            if old is not None:
                node.destroy_subscription(old)
            entity = node.create_subscription(message, topic, partial(self._take, type_, topic), _profile(kind, type_))
            self._open[topic] = entity, kind
        if age > LONELY:
            self.choice.warn_of_absent(offered, self.ledger)

    def _message(self, type_: str) -> Any:
        from rosidl_runtime_py.utilities import get_message

        try:
            return get_message(type_)
        except (ImportError, AttributeError, ValueError) as error:
            self._unknown.add(type_)
            self.ledger.warn(f"{type_} is not installed with this ROS: left out ({error})")
            return None

    def _take(self, type_: str, topic: str, message: Any) -> None:
        self.messages.receive(type_, topic, message, time.time())


def _kind(profiles: list[Any], type_: str) -> _Kind:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
    latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles)
    return reliable, latched and type_ in LATCHED


def _profile(kind: _Kind, type_: str) -> Any:
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliable, latched = kind
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1 if type_ in IMAGES else QUEUE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
