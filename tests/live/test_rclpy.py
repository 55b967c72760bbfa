"""The ROS node's logic on a stand-in for rclpy, which is not installed here: topics, QoS, and messages that arrive.

The stand-in has no more than the adapter uses, named after rclpy's documentation.
"""

import sys
import threading
from enum import Enum
from pathlib import Path
from types import ModuleType
from types import SimpleNamespace as Thing

import numpy as np
import pytest
from robot import Recorder, pose_at
from waiting import LIMIT, pause, wait_for

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker

from objslam.errors import ObjslamError
from objslam.live.adapters.rclpy import RclpyAdapter
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import TopicChoice

Reliability = Enum("Reliability", "RELIABLE BEST_EFFORT")
Durability = Enum("Durability", "VOLATILE TRANSIENT_LOCAL")
History = Enum("History", "KEEP_LAST KEEP_ALL")


class Node:
    def __init__(self):
        self.offered, self.subscriptions, self.waiting, self.destroyed = {}, {}, [], []

    def publish(self, topic, type_, reliable=True, latched=False):
        qos = Thing(
            reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
            durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        )
        self.offered.setdefault(topic, (type_, []))[1].append(Thing(qos_profile=qos))

    def get_topic_names_and_types(self):
        return [(topic, [type_]) for topic, (type_, _) in self.offered.items()]

    def get_publishers_info_by_topic(self, topic):
        return self.offered[topic][1]

    def create_subscription(self, message, topic, callback, qos):
        self.subscriptions[topic] = Thing(topic=topic, message=message, callback=callback, qos=qos)
        return self.subscriptions[topic]

    def destroy_subscription(self, subscription):
        self.destroyed.append(subscription.topic)

    def destroy_node(self):
        self.destroyed.append("node")


@pytest.fixture
def node(monkeypatch):
    node = Node()

    class Executor:
        def __init__(self, context):
            self.nodes = []

        def add_node(self, added):
            self.nodes.append(added)

        def spin_once(self, timeout_sec):
            if node.waiting:
                topic, message = node.waiting.pop(0)
                node.subscriptions[topic].callback(message)
            else:
                pause(0.005)

        def shutdown(self):
            assert self.nodes == [node]

    def get_message(type_):
        if type_.startswith("vision_msgs"):
            raise ModuleNotFoundError("No module named 'vision_msgs'")
        return type_

    modules = {
        "rclpy": {
            "Context": Thing,
            "init": lambda **_: None,
            "create_node": lambda *_, **__: node,
            "shutdown": lambda **_: None,
        },
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.signals": {"SignalHandlerOptions": Thing(NO=0)},
        "rclpy.qos": {
            "ReliabilityPolicy": Reliability,
            "DurabilityPolicy": Durability,
            "HistoryPolicy": History,
            "QoSProfile": Thing,
        },
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return node


def test_topics_are_heard_as_their_publishers_come_and_go(node):
    node.publish("/odom", "nav_msgs/msg/Odometry")
    node.publish("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
    node.publish("/found", "vision_msgs/msg/Detection2DArray")
    sink, stop, maker = Recorder(), threading.Event(), Maker()
    adapter = RclpyAdapter(RosMessages(sink), TopicChoice())
    thread = threading.Thread(target=adapter.run, args=(stop,))
    thread.start()
    wait_for(lambda: {"/odom", "/tf_static"} <= set(node.subscriptions))
    static, odom = node.subscriptions["/tf_static"].qos, node.subscriptions["/odom"].qos
    assert (static.durability, odom.durability) == (Durability.TRANSIENT_LOCAL, Durability.VOLATILE)
    assert odom.reliability == Reliability.RELIABLE
    node.waiting = [("/odom", maker.odometry(k * 10**9, pose_at(k))) for k in range(1, 6)]
    wait_for(lambda: len(sink.odometry) == 5)
    np.testing.assert_allclose(sink.odometry[4][1], pose_at(5), atol=1e-9)
    node.publish("/odom", "nav_msgs/msg/Odometry", reliable=False)
    wait_for(lambda: node.subscriptions["/odom"].qos.reliability == Reliability.BEST_EFFORT)
    stop.set()
    thread.join(LIMIT)
    assert node.destroyed == ["/odom", "node"]
    assert adapter.ledger.warnings == [
        "vision_msgs/msg/Detection2DArray is not installed with this ROS: left out (No module named 'vision_msgs')"
    ]


def test_without_rclpy_one_line_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ObjslamError, match="rclpy cannot be imported"):
        RclpyAdapter(RosMessages(Recorder()), TopicChoice())
