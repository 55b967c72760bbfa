"""What a snapshot becomes on DDS, read by types written out by hand and cyclonedds' own deserialiser."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from domains import own_domain
from robot import LOOPBACK, messages
from scipy.spatial.transform import Rotation
from waiting import LIMIT, wait_for

from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import Snapshot
from objslam.core.trajectory import Trajectory
from objslam.ros.bag.records import Connection
from objslam.ros.messages.decode import make_decoder

pytest.importorskip("cyclonedds")

from objslam.live.dds.network import open_network
from objslam.live.dds.publisher import TOPICS, DdsPublisher, messages_of
from objslam.live.dds.types import layouts_of
from objslam.output.export.map_messages import MapMessages

COVARIANCE = np.diag([0.04, 0.01, 0.0025])


def thing(number, label, position, status="ok", **more):
    fields = {"covariance": COVARIANCE if status == "ok" else None, "status": status, "rays": 9, "frames": 9}
    fields |= {"parallax_deg": 20.0, "rms_deg": 0.3, "first_seen": 1.0, "last_seen": 2.0}
    return MapObject(id=number, label=label, position=np.array(position), **{**fields, **more})


def snapshot(poses=3):
    objects = ObjectMap(
        (
            thing(4, "cup", [1.0, 2.0, 0.5], extent=(0.1, 0.3), labels={"cup": 0.75, "mug": 0.25}),
            thing(7, "chair", [-1.0, 0.0, 0.4]),
            thing(8, "cup", [9.0, 9.0, 9.0], status="unresolved"),
        )
    )
    path = np.tile(np.eye(4), (poses, 1, 1))
    path[:, 0, 3] = np.arange(poses)
    path[:, :3, :3] = Rotation.from_euler("z", 0.4).as_matrix()
    return Snapshot(12.25, objects, Trajectory(10 + 0.1 * np.arange(poses), path))


def written_types():
    """vision_msgs 4 and nav_msgs, by hand."""
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import sequence

    made = messages()

    def struct(package, name, **fields):
        made[name] = make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)

    struct("vision_msgs", "BoundingBox3D", center=made["Pose"], size=made["Vector3"])
    results = sequence[made["ObjectHypothesisWithPose"]]
    struct("vision_msgs", "Detection3D", header=made["Header"], results=results, bbox=made["BoundingBox3D"], id=str)
    struct("vision_msgs", "Detection3DArray", header=made["Header"], detections=sequence[made["Detection3D"]])
    struct("geometry_msgs", "PoseStamped", header=made["Header"], pose=made["Pose"])
    struct("nav_msgs", "Path", header=made["Header"], poses=sequence[made["PoseStamped"]])
    return made


def test_objects_and_path_reach_those_who_come_late(monkeypatch):
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    domain = own_domain()
    publisher = DdsPublisher(open_network(domain), "/robot/map/")
    assert publisher.topics["objects"] == "/robot/map/objects"
    publisher.publish(snapshot())
    types, participant = written_types(), DomainParticipant(domain)
    qos = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
    read = {}
    for topic, name in (("rt/robot/map/objects", "Detection3DArray"), ("rt/robot/map/path", "Path")):
        reader = DataReader(participant, Topic(participant, topic, types[name]), qos=qos)
        read[name] = wait_for(lambda reader=reader: reader.take(1))[0]
    found = read["Detection3DArray"]
    assert (found.header.stamp.sec, found.header.stamp.nanosec, found.header.frame_id) == (12, 250_000_000, "map")
    cup, chair = found.detections
    assert cup.id == "4"
    assert [(r.hypothesis.class_id, r.hypothesis.score) for r in cup.results] == [("cup", 0.75), ("mug", 0.25)]
    place = cup.results[0].pose.pose.position
    assert (place.x, place.y, place.z) == (1.0, 2.0, 0.5)
    covariance = np.array(cup.results[0].pose.covariance).reshape(6, 6)
    np.testing.assert_array_equal(covariance[:3, :3], COVARIANCE)
    assert not covariance[3:].any()
    assert (cup.bbox.center.position.x, cup.bbox.size.x, cup.bbox.size.y, cup.bbox.size.z) == (1.0, 0.1, 0.1, 0.3)
    assert (chair.results[0].hypothesis.class_id, chair.results[0].hypothesis.score, chair.bbox.size.x) == (
        "chair",
        1.0,
        0.0,
    )
    path = read["Path"]
    assert path.header.frame_id == "map"
    assert [pose.pose.position.x for pose in path.poses] == [0.0, 1.0, 2.0]
    assert [pose.header.stamp.nanosec for pose in path.poses] == [0, 100_000_000, 200_000_000]
    turn = path.poses[0].pose.orientation
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, 0, np.sin(0.2), np.cos(0.2)], atol=1e-12)


def test_a_reader_that_stops_does_not_hold_the_session_up(monkeypatch):
    """It acknowledges nothing any more. A message is larger than all that the library sends without an acknowledgement."""
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    domain = own_domain()
    publisher = DdsPublisher(open_network(domain))
    writer, layout = publisher._writers["objects"], layouts_of(TOPICS["objects"])[0]

    def message(x):
        objects = (thing(1, "cup", [x, 0.0, 0.0]), *(thing(i, "c" * 100_000, [0.0] * 3) for i in range(2, 12)))
        maker = MapMessages("map")
        return layout(bytes(maker.store.serialize_cdr(maker.detections(1.0, objects), TOPICS["objects"])))

    environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(Path(__file__).with_name("map_reader.py")), str(domain)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as reader:
        try:
            writer.write(message(1.0))
            assert float(reader.stdout.readline()) == 1.0
            os.kill(reader.pid, signal.SIGSTOP)
            older, newest, written = message(2.0), message(3.0), threading.Event()

            def write():
                for _ in range(200):
                    writer.write(older)
                writer.write(newest)
                written.set()

            threading.Thread(target=write, daemon=True).start()
            assert written.wait(LIMIT)
            os.kill(reader.pid, signal.SIGCONT)
            while float(reader.stdout.readline()) != 3.0:  # The newest map arrives when the reader goes on.
                pass
        finally:
            reader.kill()


def read_back(snapshot):
    """The messages as others decode them."""
    maker = MapMessages("map")
    made = {name: maker.store.serialize_cdr(m, TOPICS[name]) for name, m in messages_of(snapshot, maker).items()}
    return {name: make_decoder(Connection("/x", TOPICS[name], "cdr"))(bytes(data)) for name, data in made.items()}


def test_markers_show_objects_with_their_ellipsoids():
    first, *rest = read_back(snapshot())["markers"].markers
    assert first.action == first.DELETEALL
    shapes = {"objects": first.SPHERE, "covariances": first.SPHERE, "labels": first.TEXT_VIEW_FACING}
    expected = {(name, number, shape) for name, shape in shapes.items() for number in (0, 1)}
    assert {(m.ns, m.id, m.type) for m in rest} == expected
    spread = next(m for m in rest if (m.ns, m.id) == ("covariances", 0))
    turn = Rotation.from_quat([getattr(spread.pose.orientation, k) for k in "xyzw"]).as_matrix()
    axes = np.array([getattr(spread.scale, k) for k in "xyz"]) / 4  # a diameter of 2 sigma on both sides
    np.testing.assert_allclose(turn @ np.diag(axes**2) @ turn.T, COVARIANCE, atol=1e-12)
    body = next(m for m in rest if (m.ns, m.id) == ("objects", 0))
    assert (body.pose.position.x, body.scale.x, body.scale.z, body.header.frame_id) == (1.0, 0.1, 0.3, "map")
    assert {m.text for m in rest if m.ns == "labels"} == {"cup #4", "chair"}
    assert all(0 < m.color.a <= 1 for m in rest)


@pytest.mark.parametrize("poses", [0, 1, 499, 500, 501, 12_345])
def test_a_long_path_is_thinned_out_and_keeps_its_end(poses):
    xs = [placed.pose.position.x for placed in read_back(snapshot(poses))["path"].poses]
    assert len(xs) <= 500
    assert len(xs) == poses or len(xs) > 250
    assert xs == sorted(xs)
    if poses:
        assert xs[-1] == poses - 1


def test_a_snapshot_of_nothing_can_be_published():
    empty = Snapshot(np.nan, ObjectMap(()), Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    read = read_back(empty)
    assert (len(read["objects"].detections), len(read["markers"].markers), len(read["path"].poses)) == (0, 1, 0)
