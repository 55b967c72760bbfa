"""A robot in another process, heard over DDS on the loopback interface."""

import itertools
import math
import os
import socket
import struct
import subprocess
import sys
import threading
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from domains import own_domain
from hypothesis import given
from hypothesis import strategies as st
from processes import running
from robot import (
    BASE_T_CAMERA,
    LOOPBACK,
    MAP_T_ODOM,
    Drive,
    Recorder,
    messages,
    pose_at,
    robot_process,
    sent,
    start,
    time_of_day,
)
from waiting import LIMIT, wait_for

pytest.importorskip("cyclonedds")
sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker, serialize
from cyclonedds.core import DDSException
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from objslam.errors import ConfigError, ObjslamError
from objslam.live.adapters.dds import DdsAdapter
from objslam.live.dds.network import open_network
from objslam.live.dds.publications import Publication
from objslam.live.dds.types import dds_topic, dds_type, layouts_of, ros_topic, ros_type
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import TopicChoice
from objslam.sources.ros_bag.options import RosOptions

SURE, UNSURE = (True, False), (False, False)  # Kinds of publishers: reliable, latched.


@pytest.fixture
def domain(monkeypatch):
    """A domain that nobody else is in. Boxes wait for their camera, however slow the machine is."""
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    monkeypatch.setattr("objslam.live.ros.camera_registry.PATIENCE", LIMIT)
    return own_domain()


@contextmanager
def listening(domain, **choices):
    """A recorder that hears a domain, and its adapter."""
    sink = Recorder()
    messages = RosMessages(sink, RosOptions(topics=tuple(f"{role}={name}" for role, name in choices.items())))
    adapter = DdsAdapter(open_network(domain), messages, TopicChoice(messages.chosen))
    stop = threading.Event()
    thread = threading.Thread(target=adapter.run, args=(stop,))
    thread.start()
    try:
        yield sink, adapter
    finally:
        stop.set()
        thread.join(LIMIT)
    assert not thread.is_alive()


def stamps(rows):
    return [round(row[0], 6) for row in rows]


def test_no_two_tests_are_in_one_domain(domain):
    another = own_domain()
    script = (
        f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from domains import own_domain; print(own_domain())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LIMIT, check=True)
    assert len({domain, another, int(done.stdout)}) == 3


def test_all_of_a_robot_arrives(domain):
    with listening(domain) as (sink, adapter):
        said = sent(start(Drive(domain, seconds=2.0, bad=2)))
        wait_for(lambda: [len(sink.odometry), len(sink.detections)] == [len(said[kind]) for kind in said])
    assert stamps(sink.odometry) == [round(stamp, 6) for stamp in said["odometry"]]
    assert stamps(sink.detections) == [round(stamp, 6) for stamp in said["detections"]]
    np.testing.assert_allclose(
        [row[1] for row in sink.odometry], [pose_at(k / 200) for k in range(len(sink.odometry))], atol=1e-9
    )
    assert sink.odometry[0][2][0, 0] == 0.01
    (camera,) = sink.cameras
    np.testing.assert_allclose(camera.base_T_camera, BASE_T_CAMERA, atol=1e-9)  # sent before anyone listened
    assert (camera.name, camera.width, camera.height, camera.focal) == ("front", 640, 480, 500)
    _, name, boxes, labels, scores, tracks, _ = sink.detections[0]
    assert (name, labels, tracks) == ("front", [f"cup{i}" for i in range(5)], list(range(5)))
    np.testing.assert_allclose(boxes, [[80 + 90 * i, 170, 120 + 90 * i, 230] for i in range(5)])
    np.testing.assert_allclose(scores, 0.9)
    ((stamp, pose, _),) = sink.localization
    at = stamps(sink.odometry).index(round(stamp, 6))
    np.testing.assert_allclose(pose, MAP_T_ODOM @ sink.odometry[at][1], atol=1e-9)
    assert adapter.ledger.dropped == {"message that cannot be decoded": 2}


def test_what_arrives_of_a_robot_that_sends_once_is_what_it_sent(domain):
    """Best effort: a busy machine may lose some of it."""
    with listening(domain) as (sink, _), robot_process(Drive(domain, seconds=3600.0, reliable=False)):
        wait_for(lambda: len(sink.odometry) > 100 and len(sink.detections) > 10)
    found = stamps(sink.odometry), stamps(sink.detections)
    assert all((np.diff(rows) > 0).all() for rows in found)
    turns = np.array([np.arctan2(row[1][1, 0], row[1][0, 0]) for row in sink.odometry])
    steps = np.diff(np.unwrap(turns)) / (0.5 / 200)  # its odometry turns by so much from one message to the next
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert (np.round(steps) >= 1).all()
    assert all(row[3] == [f"cup{i}" for i in range(5)] for row in sink.detections)


def test_a_robot_that_is_killed_and_starts_again_is_heard_again(domain):
    with listening(domain) as (sink, _):
        with robot_process(Drive(domain, seconds=3600.0)):
            wait_for(lambda: len(sink.detections) > 5)
        killed = time_of_day()
        said = sent(start(Drive(domain, seconds=1.0)))
        wait_for(lambda: stamps(sink.odometry)[-1] == round(said["odometry"][-1], 6))
        wait_for(lambda: stamps(sink.detections)[-1] == round(said["detections"][-1], 6))
    for kind, rows in (("odometry", sink.odometry), ("detections", sink.detections)):
        assert [stamp for stamp in stamps(rows) if stamp > killed] == [round(stamp, 6) for stamp in said[kind]]


def test_reliable_and_best_effort_publishers_of_one_topic_are_each_heard_once(domain):
    with listening(domain, odometry="/odom", detections="none") as (sink, _):
        drives = [Drive(domain, seconds=1.0, reliable=reliable, heard=("odom",)) for reliable in (True, False)]
        with robot_process(drives[0]) as one, robot_process(drives[1]) as other:
            said = [sent(robot)["odometry"] for robot in (one, other)]
        # Two messages of two robots may bear the same microsecond, so messages are counted, not only looked for.
        surely, perhaps = (Counter(round(stamp, 6) for stamp in stamps) for stamps in said)
        # Best effort may lose some on a busy machine.
        wait_for(lambda: (heard := Counter(stamps(sink.odometry))) >= surely and heard & perhaps)
    assert surely <= Counter(stamps(sink.odometry)) <= surely + perhaps


def test_a_reliable_publisher_beside_a_best_effort_one_is_heard_before_a_reliable_reader_is_there(domain, monkeypatch):
    """It sends as soon as the best-effort reader hears it."""
    other = Drive(domain, seconds=3600.0, reliable=False, heard=("odom",))
    with listening(domain, odometry="/odom", detections="none") as (sink, adapter), robot_process(other):
        wait_for(lambda: len(sink.odometry) > 20)
        monkeypatch.setattr("objslam.live.adapters.dds.LOOK_EVERY", math.inf)  # No other reader will be there.
        said = Counter(round(stamp, 6) for stamp in sent(start(Drive(domain, seconds=1.0, heard=("odom",))))["odometry"])
        # A few messages of two robots may bear the same microsecond, and best effort may lose some on a busy machine.
        wait_for(lambda: (Counter(stamps(sink.odometry)) & said).total() > 20)
        assert [reliable for topic, (reliable, _) in adapter._readers if topic == "/odom"] == [False]


@given(st.data())
def test_each_message_that_two_readers_receive_is_pushed_once(data):
    """The best-effort reader loses some; the reliable one is there later, and loses none. Their turns come in any order."""
    count = data.draw(st.integers(1, 30))
    first = data.draw(st.integers(0, count))
    some = data.draw(st.lists(st.booleans(), min_size=count, max_size=count))
    readers = [SimpleNamespace(of=Publication("/odom", "nav_msgs/msg/Odometry", kind, None)) for kind in (SURE, UNSURE)]
    received = [[*range(first, count)], [stamp for stamp in range(count) if some[stamp]]]
    adapter = DdsAdapter(SimpleNamespace(), RosMessages(Recorder(), RosOptions()), SimpleNamespace())
    adapter._publications.add(7, readers[0].of)
    pushed = []
    for turn in data.draw(st.permutations([0] * len(received[0]) + [1] * len(received[1]))):
        stamp = received[turn].pop(0)
        if adapter._is_mine(readers[turn], 7, stamp, None):
            pushed.append(stamp)
    early = [stamp for stamp in range(first) if some[stamp]]
    assert sorted(pushed) == early + list(range(first, count))


def test_a_payload_that_is_malformed_on_the_wire_is_counted(domain):
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

    network = open_network(domain)
    found = BuiltinDataReader(network.participant, BuiltinTopicDcpsPublication)
    with listening(domain) as (sink, adapter), robot_process(Drive(domain, seconds=3600.0, reliable=False)):
        wait_for(lambda: len(sink.odometry) > 20)
        (writer,) = [sample.key.bytes for sample in found.take(100) if sample.topic_name == "rt/odom"]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            for number, payload in ((100_000, b"\0\1\0\0garbage!"), (100_001, b"\0\1\0\0" + b"\xff" * 64)):
                for index in range(8):
                    port = 7400 + 250 * domain + 11 + 2 * index
                    wire.sendto(rtps_data(writer, number, payload), ("127.0.0.1", port))
        reason = "malformed payload (DDS)"
        wait_for(lambda: adapter.ledger.dropped.get(reason, 0) >= 2)
        count = len(sink.detections)
        wait_for(lambda: len(sink.detections) > count)
    assert adapter.ledger.examples[reason][0] == "/odom"


def rtps_data(writer: bytes, number: int, payload: bytes) -> bytes:
    """A packet with one DATA submessage, little-endian, after the RTPS specification, 9.4.5.3."""
    body = struct.pack("<HH", 0, 16) + bytes(4) + writer[12:] + struct.pack("<iI", 0, number) + payload
    return b"RTPS\x02\x01\x01\x10" + writer[:12] + struct.pack("<BBH", 0x15, 0x05, len(body)) + body


def test_an_older_layout_of_vision_msgs_is_read(domain):
    newer, older = layouts_of("vision_msgs/msg/Detection2DArray")
    assert newer.__idl__.get_type_id() == messages()["Detection2DArray"].__idl__.get_type_id()
    maker = Maker("2")
    with (
        listening(domain, odometry="/odom", detections="/old") as (sink, _),
        robot_process(Drive(domain, seconds=1.0, heard=("odom", "tf", "info"))) as robot,
    ):
        participant = DomainParticipant(domain)
        writer = DataWriter(participant, Topic(participant, "rt/old", older))
        wait_for(lambda: len(sink.odometry) > 10 and writer.get_matched_subscriptions())
        box = [(1, 2, 30, 40, "mug", 0.5, "4")]
        message = maker.detections(round(time_of_day() * 1e9), box, "front_optical_frame")
        writer.write(older(serialize(maker, message)))
        wait_for(lambda: sink.detections)
        sent(robot)
    ((_, _, boxes, labels, scores, tracks, _),) = sink.detections
    np.testing.assert_allclose(boxes, [box[0][:4]])
    assert (labels, scores.tolist(), tracks) == (["mug"], [0.5], [4])


def test_the_library_writes_nothing_to_the_terminal():
    """A session in a process of its own receives a malformed payload."""
    domain = own_domain()
    listener = """
import sys, time
from objslam.live.dds.network import open_network
network = open_network(int(sys.argv[1]))
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from objslam.live.dds.types import layouts_of
reader = DataReader(network.participant, Topic(network.participant, "rt/odom", layouts_of("nav_msgs/msg/Odometry")[0]))
while network.unread["rt/odom"] < 20:
    time.sleep(0.01)
"""
    env = {name: value for name, value in os.environ.items() if name != "CYCLONEDDS_URI"}
    command = [sys.executable, "-c", listener, str(domain)]
    network, numbers = open_network(domain), itertools.count(10)
    writer = DataWriter(network.participant, Topic(network.participant, "rt/odom", layouts_of("nav_msgs/msg/Odometry")[0]))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with (
        running(command, env=env, text=True, **pipes) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
    ):
        wait_for(writer.get_matched_subscriptions)

        def ended():
            packet = rtps_data(writer.get_guid().bytes, next(numbers), b"\0\1\0\0garbage!")
            for index in range(8):
                wire.sendto(packet, ("127.0.0.1", 7400 + 250 * domain + 11 + 2 * index))
            return process.poll() is not None

        wait_for(ended)
        assert process.communicate() == ("", "")
        assert process.returncode == 0


def test_a_type_that_nobody_knows_is_left_out_with_a_warning():
    adapter = DdsAdapter(None, RosMessages(Recorder()), TopicChoice())
    adapter._publications.add(1, Publication("/tags", "my_apriltag/msg/TagArray", (True, False), None))
    assert adapter._open(0.0) == []
    assert adapter.ledger.warnings == [
        "/tags: left out, because its type my_apriltag/msg/TagArray is unknown and DDS sends no definitions"
    ]


def test_the_types_are_those_that_others_use():
    from cyclonedds.idl import IdlStruct

    written = messages()
    for name, type_ in (
        ("Odometry", "nav_msgs/msg/Odometry"),
        ("TFMessage", "tf2_msgs/msg/TFMessage"),
        ("CameraInfo", "sensor_msgs/msg/CameraInfo"),
        ("Detection2DArray", "vision_msgs/msg/Detection2DArray"),
    ):
        ids = [layout.__idl__.get_type_id() for layout in layouts_of(type_)]
        assert issubclass(layouts_of(type_)[0], IdlStruct)
        assert written[name].__idl__.get_type_id() in ids
    assert layouts_of("unknown_msgs/msg/Thing") == ()


def test_names_go_there_and_back():
    assert dds_topic("/a/odom") == "rt/a/odom"
    assert ros_topic("rt/a/odom") == "/a/odom"
    assert ros_topic("rq/service") is None
    assert dds_type("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert ros_type("nav_msgs::msg::dds_::Odometry_") == "nav_msgs/msg/Odometry"
    assert ros_type("Plain") is None


def test_nothing_listens_beyond_the_loopback_interface(domain):
    before = set(_datagram_sockets())
    open_network(domain)
    opened = set(_datagram_sockets()) - before
    assert len(opened) >= 2
    for number in opened:
        with socket.socket(fileno=os.dup(number)) as own:
            host = own.getsockname()[0]
            device = own.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
            assert host == "127.0.0.1" or device.rstrip(b"\0") == b"lo", (host, device)


def _datagram_sockets():
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if str(entry.readlink()).startswith("socket:"):
                with socket.socket(fileno=os.dup(int(entry.name))) as own:
                    if own.type == socket.SOCK_DGRAM and own.family == socket.AF_INET:
                        yield int(entry.name)
        except OSError:
            continue


def test_settings_of_the_user_are_kept(domain, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    network = open_network()
    assert (network.domain, network.where) == (domain, "CYCLONEDDS_URI")
    assert open_network() is network
    with pytest.raises(ConfigError, match="open on CYCLONEDDS_URI already"):
        open_network(domain, "auto")


SECURITY = (
    '<CycloneDDS><Domain Id="any"><Security><Authentication><Library path="dds_security_auth"'
    ' initFunction="init_authentication" finalizeFunction="finalize_authentication"/>'
    "<IdentityCA>file:/no/ca.pem</IdentityCA><IdentityCertificate>file:/no/own.pem</IdentityCertificate>"
    "<PrivateKey>file:/no/key.pem</PrivateKey></Authentication></Security></Domain></CycloneDDS>"
)


def test_security_settings_reach_the_library_as_they_are(domain, monkeypatch):
    given = []

    def refuse(number, settings):
        given.append((number, settings))
        raise DDSException(DDSException.DDS_RETCODE_ERROR)

    monkeypatch.setenv("CYCLONEDDS_URI", SECURITY)
    monkeypatch.setattr("cyclonedds.domain.Domain", refuse)
    with pytest.raises(ObjslamError, match="cannot be joined on CYCLONEDDS_URI"):
        open_network(domain)
    ((number, settings),) = given
    own = settings.removeprefix(f"{SECURITY},")
    assert number == domain
    assert settings != own
    assert {element.tag for element in ElementTree.fromstring(own).find("Domain")} == {"Tracing", "Internal"}


def test_without_security_or_keys_no_session_begins_in_the_clear(domain, monkeypatch):
    """A library without security does not know the settings, and one with it does not find the keys."""
    monkeypatch.setenv("CYCLONEDDS_URI", SECURITY)
    before = set(_datagram_sockets())
    with pytest.raises(ObjslamError, match=rf"DDS domain {domain} cannot be joined on CYCLONEDDS_URI"):
        open_network(domain)
    assert set(_datagram_sockets()) == before


@pytest.mark.parametrize("given", [-1, 233])
def test_a_domain_that_cannot_be_is_wrong_use(given):
    with pytest.raises(ConfigError, match="no DDS domain"):
        open_network(given)


@pytest.mark.parametrize("interface", ['lo"/><x', "a b", ""])
def test_an_interface_that_cannot_be_is_wrong_use(domain, interface):
    with pytest.raises(ConfigError, match="not a network interface"):
        open_network(domain, interface)


def test_an_interface_that_is_not_there(domain):
    with pytest.raises(ObjslamError, match="cannot be joined on the interface nosuch0"):
        open_network(domain, "nosuch0")


def test_without_cyclonedds_one_line_says_so(domain, monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(ObjslamError, match=r"not installed \(pip install"):
        open_network(domain)


def test_no_thread_of_the_library_runs_when_the_interpreter_ends(domain):
    # A joined thread stays in the kernel's list for a moment, and its entry may go while it is read. So the end looks again.
    script = """
import atexit, pathlib, sys, time
def names():
    found = set()
    for task in pathlib.Path("/proc/self/task").iterdir():
        try:
            found.add(task.joinpath("comm").read_text().strip())
        except OSError:
            continue
    return found
def at_the_end():
    for _ in range(100):
        if not {"gc", "recv", "tev"} & names():
            break
        time.sleep(0.02)
    print("end", *names())
atexit.register(at_the_end)  # The last function that runs, because it is registered first.
from objslam.live.dds.network import open_network
from objslam.live.dds.publisher import DdsPublisher
publisher = DdsPublisher(open_network(int(sys.argv[1])))
print("during", *names())
"""
    command = [sys.executable, "-c", script, str(domain)]
    during, after = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LIMIT).stdout.splitlines()
    assert {"gc", "recv", "tev"} <= set(during.split())
    assert not {"gc", "recv", "tev"} & set(after.split())
