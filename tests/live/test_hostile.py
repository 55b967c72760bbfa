"""An open network: whatever a publisher sends is counted, costs a bounded memory, and moves nobody's clock."""

import struct
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker, serialize
from cyclonedds.core import InstanceState, Qos
from robot import Recorder, time_of_day

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.live.adapters.dds import DdsAdapter
from objslam.live.counters import Counters
from objslam.live.dds.publications import MOST, Publication, Publications
from objslam.live.dds.types import dds_type
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import TopicChoice
from objslam.live.session import intake as intakes
from objslam.live.session.intake import Intake
from objslam.live.session.session import Session
from objslam.ros.bag.records import Connection
from objslam.ros.message_limits import check_size
from objslam.ros.messages.decode import DecodeError, make_decoder
from objslam.ros.messages.topic_types import DETECTIONS, ODOMETRY, TRANSFORMS
from objslam.simulation import make_camera
from objslam.sources.ros_bag.options import RosOptions

SETTINGS = load_settings(None, ("mode=joint",))
S = 10**9
MAKER = Maker()
EYE = np.eye(4)


@pytest.fixture
def robot():
    """A function that sends bytes as a publisher does, the intake that hears them, and what it accepted."""
    taken = []

    def deliver(message, arrival):
        taken.append(message)
        return True

    entry = Intake(SETTINGS, Counters(), deliver)
    messages = RosMessages(entry, clock=lambda: 1.0)
    decoders = {}

    def send(topic, type_, data):
        decode = decoders.setdefault(type_, make_decoder(Connection(topic, type_, "cdr")))
        try:
            check_size(type_, data, "cdr")
            messages.receive(type_, topic, decode(data), time_of_day())
        except DecodeError as error:
            messages.refuse("message that cannot be decoded", f"{topic}: {error}")

    return send, entry, messages, taken


def odometry(stamp, x=0.0):
    pose = EYE.copy()
    pose[0, 3] = x
    return serialize(MAKER, MAKER.odometry(round(stamp * S), pose))


def boxes(count):
    """A message with `count` boxes, all of them the same bytes."""
    one, two = (serialize(MAKER, MAKER.detections(S, [(1, 2, 30, 40, "cup", 0.9, "7")] * n)) for n in (1, 2))
    at = next(i for i in range(4, len(one), 4) if one[i : i + 4] == b"\1\0\0\0" and two[i : i + 4] == b"\2\0\0\0")
    body = two[at + 4 + (len(two) - len(one)) :]
    return two[:at] + struct.pack("<I", count) + body * count


def test_a_million_boxes_are_refused_before_they_are_decoded(robot):
    send, _, messages, taken = robot
    data = boxes(10**6)
    assert len(data) > 10**8
    send("/boxes", DETECTIONS, data)
    send("/boxes", DETECTIONS, data[:400])  # It says that it has a million boxes, but ends early.
    assert messages.ledger.dropped == {"message that cannot be decoded": 2}
    assert "more than 10000 detections" in messages.ledger.lines()[0]
    assert not taken


def test_numbers_that_are_none_and_stamps_that_cannot_be(robot):
    send, entry, messages, taken = robot
    send("/odom", ODOMETRY, odometry(1.0))
    good = odometry(2.0)
    place = good.index(struct.pack("<d", 1.0))  # the w of the quaternion
    for value in (np.nan, np.inf, -np.inf, 0.0, 1e300):
        send("/odom", ODOMETRY, good[:place] + struct.pack("<d", value) + good[place + 8 :])
    for seconds in (-(2**31), -100, 2**31 - 1):
        send("/odom", ODOMETRY, good[:4] + struct.pack("<iI", seconds, 2**32 - 1) + good[12:])
    for cut in range(0, len(good), 7):
        send("/odom", ODOMETRY, good[:cut])
    entry.end()
    lost = sum(messages.ledger.dropped.values()) + sum(entry.counters.dropped().values())
    assert lost == 4 + 3 + len(range(0, len(good), 7)) + (1 if len(taken) == 1 else 0)
    assert entry.newest == 1.0
    assert all(np.isfinite(message.pose).all() for message in taken)


def test_one_message_moves_no_clock(robot):
    """Single stamps that are far ahead, or back by little or much, among poses at 200 Hz."""
    send, entry, _, taken = robot
    for i in range(400):
        send("/odom", ODOMETRY, odometry(10 + 0.005 * i, 0.001 * i))
        if i in (150, 200, 250, 300):
            wrong = {150: 70.0, 200: 1e6, 250: -3.0, 300: -1e4}[i]
            send("/odom", ODOMETRY, odometry(max(0.001, 10 + 0.005 * i + wrong), 0.0))
    assert len(taken) == 400
    assert [message.stamp for message in taken] == pytest.approx([10 + 0.005 * i for i in range(400)])
    assert sum(entry.counters.dropped().values()) == 4


class Discovery:
    """What DDS found: publishers with topics and types, as cyclonedds gives them."""

    def __init__(self, offered):
        info = SimpleNamespace(instance_state=InstanceState.Alive, valid_data=True)
        self.samples = [
            SimpleNamespace(
                topic_name=f"rt{topic}",
                type_name=dds_type(type_),
                qos=Qos(),
                type_id=None,
                participant_key=None,
                sample_info=SimpleNamespace(**vars(info), instance_handle=handle),
            )
            for handle, (topic, type_) in enumerate(offered)
        ]

    def take(self, count):
        taken, self.samples = self.samples[:count], self.samples[count:]
        return taken


def test_topics_without_end_cost_a_bounded_memory():
    odometry = [("/odom", ODOMETRY)]
    other = [(f"/made/up{i}", f"made_up{i}/msg/Thing") for i in range(20_000)]
    same = [(f"/odom{i}", ODOMETRY) for i in range(5_000)]
    tags = [(f"/tags{i}", f"apriltag{i}/msg/TagArray") for i in range(5_000)]
    messages = RosMessages(Recorder())
    network = SimpleNamespace(participant=SimpleNamespace(guid="this session"))
    adapter, found = DdsAdapter(network, messages, TopicChoice(messages.chosen)), Discovery(odometry + other + same + tags)
    rounds = 0
    while found.samples:
        adapter._look_around(found)
        rounds += 1
    assert rounds >= 30  # Between two of them, messages are taken.
    assert len(adapter._publications) == 1000
    wanted = adapter.choice.wanted({p.topic: p.type for p in adapter._publications}, messages, True)
    assert {topic for topic in wanted if not topic.startswith("/tags")} == {"/odom"}
    assert adapter.ledger.dropped == {"publisher beyond the 1000 that are kept": 9001}


def test_made_up_topics_do_not_crowd_out_a_robot_that_comes_later():
    """Of the type that is made up, and of others; and a topic that the user named, whatever its name is."""
    robot = [
        ("/odom", ODOMETRY),
        ("/tf", TRANSFORMS[0]),
        ("/front/detections", DETECTIONS),
        ("/a/very/long/name", ODOMETRY),
    ]
    odometry = [(f"/made/up{i}", ODOMETRY) for i in range(5_000)]
    tags = [(f"/made/up{i}", f"apriltag{i}/msg/TagArray") for i in range(5_000)]
    for made_up, named in ((odometry, False), (odometry, True), (tags, False)):
        messages = RosMessages(Recorder(), RosOptions(topics=("odometry=/a/very/long/name",) * named))
        network = SimpleNamespace(participant=SimpleNamespace(guid="this session"))
        adapter, found = DdsAdapter(network, messages, TopicChoice(messages.chosen)), Discovery(made_up + robot)
        while found.samples:
            adapter._look_around(found)
        assert len(adapter._publications) == 1000
        wanted = adapter.choice.wanted({p.topic: p.type for p in adapter._publications}, messages, True)
        real = {topic for topic in wanted if made_up is odometry or not topic.startswith("/made")}
        assert real == {"/tf", "/front/detections", "/a/very/long/name" if named else "/odom"}
        assert adapter.ledger.dropped == {"publisher beyond the 1000 that are kept": 4004}


def test_publishers_that_are_kept_never_give_way():
    kept = Publications(lambda: {f"/read{i}" for i in range(MOST)})
    for i in range(MOST):
        assert kept.add(i, Publication(f"/read{i}", ODOMETRY, (True, False), None)) is None
    new = Publication("/a", DETECTIONS, (True, False), None)
    assert kept.add(MOST, new) is new
    gone = kept.remove(0)
    assert gone is not None
    assert kept.add(MOST, new) is None
    assert list(kept)[-1] is new
    assert [kept.kind(handle) for handle in (0, MOST, MOST + 1)] == [new.kind, new.kind, None]  # Also of one that went.
    assert kept.add(MOST, new) is None  # DDS tells of a publisher again when its QoS changes.
    assert len(kept) == MOST


def test_warnings_without_end_are_counted():
    ledger = Ledger()
    for i in range(1500):
        ledger.warn(f"topic {i} is unknown")
        ledger.warn("topic 0 is unknown")
    assert len(ledger.warnings) == 1000
    assert ledger.dropped == {"warnings beyond the first 1000": 500}


def test_a_flood_costs_a_bounded_memory(monkeypatch):
    """Cameras, labels, tracks and stamps that never repeat, many times more than a session keeps."""
    monkeypatch.setattr(intakes, "_MOST_LABELS", 500)
    settings = load_settings(None, ("mode=joint", "live.max_keyframes=50", "live.calibrate_from=0"))
    session = Session(settings, patient=True).start()
    session.push_camera(make_camera("front"))

    def flood(first):
        for i in range(first, first + 200):
            session.push_camera(make_camera(f"camera {i}"))
            session.push_odometry(0.05 * i, EYE)
            labels = [f"label {i} {j}" for j in range(10)]
            session.push_detections(0.05 * i, "front", [[10, 10, 90, 90]] * 10, labels, [0.9] * 10, track_ids=range(10))
            session.push_detections(0.05 * i, f"camera {i}", [[10, 10, 90, 90]], ["cup"], [0.9])
            session.wait()

    flood(0)
    tracemalloc.start()
    flood(200)
    first = tracemalloc.get_traced_memory()[0]
    flood(400)
    second = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    dropped = session.counters.dropped()
    session.abort()
    assert second - first < 200_000
    assert dropped["camera beyond the first 256"] == 345
    assert dropped["box with a label beyond the first 500"] == 5501
