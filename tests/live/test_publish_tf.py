"""The tf map -> odom that a session sends: its numbers, who hears it, and when it must not be sent."""

import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from domains import own_domain
from robot import MAP_T_ODOM, Recorder, messages
from small_log import small_log
from waiting import LIMIT, wait_for

from objslam.config import load_settings
from objslam.core.geometry import interpolate, inverse, lift_se2
from objslam.core.object_map import ObjectMap
from objslam.core.snapshot import Snapshot
from objslam.core.trajectory import Trajectory
from objslam.live.adapters.replay import events
from objslam.live.ros.message_handler import RosMessages
from objslam.live.session.session import Session
from objslam.simulation import PoseNoise

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))

NOWHERE = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


def correction_of(log):
    """What a session says of a log at its end, and the stamp of its newest keyframe."""
    session = Session(load_settings(None, ("mode=joint", "calibration.use=false")), patient=True).start()
    session.push_camera(log.cameras[0].camera)
    for _, frame, push in events(log):
        push(session)
        if frame:
            assert session.wait(LIMIT)
    snapshot = session.snapshot()
    session.abort()
    return snapshot


def test_the_correction_takes_the_odometry_to_the_map():
    """The odometry begins elsewhere and drifts. The localisation is exact, so the truth of the correction is known."""
    log = small_log(localization=PoseNoise(xy=1e-6, yaw=1e-6))
    snapshot = correction_of(log)
    asked = np.array([snapshot.stamp])
    (odom_T_base,), _ = interpolate(log.odometry.stamps, log.odometry.poses, asked, np.inf)
    (map_T_base,), _ = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, asked, np.inf)
    true = map_T_base @ inverse(odom_T_base)
    assert np.linalg.norm(true[:2, 3]) > 0.05
    np.testing.assert_allclose(snapshot.map_T_odom[:3, 3], true[:3, 3], atol=0.03)
    np.testing.assert_allclose(snapshot.map_T_odom[:3, :3], true[:3, :3], atol=0.02)


def test_without_odometry_there_is_no_correction():
    assert Session(load_settings(None, ())).snapshot().map_T_odom is None


def test_tf_reaches_others_and_is_dated_ahead(monkeypatch):
    pytest.importorskip("cyclonedds")
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from objslam.live.adapters.dds import DdsAdapter
    from objslam.live.dds.network import open_network
    from objslam.live.dds.transform_publisher import TransformPublisher
    from objslam.live.ros.topic_discovery import TopicChoice

    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    domain = own_domain()
    network, said = open_network(domain), ["wheels/odom"]
    participant, made = DomainParticipant(domain), messages()
    qos = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))
    reader = DataReader(participant, Topic(participant, "rt/tf", made["TFMessage"]), qos=qos)
    sink = Recorder()
    session = RosMessages(sink)
    stop = threading.Event()
    adapter = DdsAdapter(network, session, TopicChoice(session.chosen, images=False))
    running = threading.Thread(target=adapter.run, args=(stop,))
    running.start()
    try:
        publisher = TransformPublisher(network, lambda: said[0])
        publisher.send(5.0)  # nothing is known yet
        publisher.update(Snapshot(12.25, ObjectMap(()), NOWHERE, map_T_odom=MAP_T_ODOM))
        wait_for(lambda: reader.get_matched_publications() and any(topic == "/tf" for topic, _ in adapter._readers))

        def heard():
            publisher.send(20.5)
            return reader.take(1)

        (transform,) = wait_for(heard)[0].transforms
        said[0] = None  # somebody else places the odometry now
        reader.take(100)
        publisher.send(21.0)
    finally:
        stop.set()
        running.join(LIMIT)
    for one in adapter._readers.values():
        one.since -= 1000.0
    adapter._say_what_is_missing(1000.0)
    assert adapter.ledger.warnings == []  # nor does it miss what it sends itself
    assert session._tf.frames == set()  # the session listens to tf too, and does not hear itself
    assert not reader.take(10)
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "wheels/odom")
    assert 20.5 < transform.header.stamp.sec + 1e-9 * transform.header.stamp.nanosec < 21.0
    place, turn = transform.transform.translation, transform.transform.rotation
    assert [place.x, place.y, place.z] == MAP_T_ODOM[:3, 3].tolist()
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def test_odometry_that_tf_places_already_is_left_alone():
    from bag_writer import Maker

    make, robot = Maker(), RosMessages(Recorder())
    assert robot.odom_frame() is None
    robot.receive("nav_msgs/msg/Odometry", "/odom", make.odometry(10**9, lift_se2(np.zeros(3))), 1.0)
    assert robot.odom_frame() == "odom"
    robot.receive("tf2_msgs/msg/TFMessage", "/tf", make.tf(10**9, ("map", "odom", MAP_T_ODOM)), 1.0)
    assert robot.odom_frame() is None
