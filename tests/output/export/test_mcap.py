"""The MCAP export, read by mcap's own reader and by a ROS 2 library."""

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from objslam.core.bodies.body import Body
from objslam.core.geometry import quaternion
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.errors import OutputError
from objslam.io.results.read import load_map, load_trajectory
from objslam.output.export import write_export
from objslam.output.export.content import load_content
from objslam.output.export.formats.mcap_file import EXPORT
from objslam.output.export.map_messages import MapMessages


@pytest.fixture(scope="module")
def file(result, tmp_path_factory):
    return write_export(result, "mcap", tmp_path_factory.mktemp("mcap") / "map.mcap")


@pytest.fixture(scope="module")
def messages(file):
    """Topic -> its messages, decoded by the definitions in the file."""
    found = {}
    with AnyReader([file]) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(data, connection.msgtype)))
    return found


def test_the_file_is_whole_and_says_what_it_holds(file):
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count
    assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == {
        "/objslam/objects": "vision_msgs/msg/Detection3DArray",
        "/objslam/markers": "visualization_msgs/msg/MarkerArray",
        "/objslam/path": "nav_msgs/msg/Path",
        "/objslam/pose": "geometry_msgs/msg/PoseStamped",
    }
    assert all(s.encoding == "ros2msg" for s in summary.schemas.values())
    assert all(c.message_encoding == "cdr" for c in summary.channels.values())
    with file.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    assert chunks
    assert all(chunk.uncompressed_crc for chunk in chunks)


def test_the_map_waits_for_whoever_joins_late(file):
    with file.open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    for channel in channels:
        if channel.topic != "/objslam/pose":
            (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
            assert (profile["reliability"], profile["durability"], profile["depth"]) == (1, 1, 1)  # transient local


def test_the_objects(messages, result):
    ((stamp, message),) = messages["/objslam/objects"]
    start = load_trajectory(result).stamps[0]
    assert stamp == round(start * 1e9)
    assert message.header.frame_id == "map"
    assert message.header.stamp.sec + message.header.stamp.nanosec / 1e9 == pytest.approx(start, abs=1e-6)
    shown = load_map(result).resolved()
    assert [int(d.id) for d in message.detections] == [o.id for o in shown]
    for detection, o in zip(message.detections, shown, strict=True):
        place = detection.bbox.center.position
        assert [place.x, place.y, place.z] == o.position.tolist()
        height = o.body.size[2] if o.body else o.extent[1] if o.extent else 0.0
        assert detection.bbox.size.z == height
        hypothesis = detection.results[0]
        assert hypothesis.hypothesis.class_id == next(iter(o.labels)) if o.labels else o.label
        covariance = np.asarray(hypothesis.pose.covariance).reshape(6, 6)
        np.testing.assert_array_equal(covariance[:3, :3], o.covariance)


def test_the_markers(messages, result):
    ((_, message),) = messages["/objslam/markers"]
    shown = load_map(result).resolved()
    names = [(m.ns, m.id) for m in message.markers]
    assert len(set(names)) == len(names) == 3 * len(shown)
    texts = [m.text for m in message.markers if m.ns == "labels"]
    assert all(m.type == m.TEXT_VIEW_FACING for m in message.markers if m.ns == "labels")
    assert all(o.label in text for o, text in zip(shown, texts, strict=True))
    for marker, o in zip([m for m in message.markers if m.ns == "covariances"], shown, strict=True):
        axes = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
        turn = marker.pose.orientation
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        # the diameters of the 2-sigma ellipsoid
        np.testing.assert_allclose(rotation @ np.diag((axes / 4) ** 2) @ rotation.T, o.covariance, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "yaw_sigma", "expected"),
    [("ellipsoid", 0.02, "SPHERE"), ("cylinder", 0.02, "CYLINDER"), ("cuboid", 0.02, "CUBE"), ("cuboid", 0.9, "CYLINDER")],
)
def test_the_marker_of_a_body_has_its_shape_size_and_yaw(shape, yaw_sigma, expected):
    size = np.array([0.8, 0.02, 0.5])  # A flat thing, such as a picture. Its marker must not be thicker.
    body = Body(shape, size, 0.6, np.full(3, 0.01), yaw_sigma)
    thing = MapObject(
        3, "cabinet", np.array([1.0, 2.0, 0.25]), 1e-4 * np.eye(3), "ok", 40, 40, 50.0, 0.5, 0.0, 9.0, body=body
    )
    (marker,) = [m for m in MapMessages("map").markers(0.0, ObjectMap((thing,))).markers if m.ns == "objects"]
    turn = marker.pose.orientation
    assert marker.type == getattr(marker, expected)
    assert [marker.scale.x, marker.scale.y, marker.scale.z] == size.tolist()
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, 0, np.sin(0.3), np.cos(0.3)], atol=1e-12)


def test_the_path_and_the_pose_over_time(messages, result):
    trajectory = load_trajectory(result)
    ((_, path),) = messages["/objslam/path"]
    for poses in (list(path.poses), [m for _, m in messages["/objslam/pose"]]):
        places = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses]
        np.testing.assert_array_equal(places, trajectory.poses[:, :3, 3])
        turns = [[getattr(p.pose.orientation, axis) for axis in "xyzw"] for p in poses]
        np.testing.assert_allclose(turns, quaternion(trajectory.poses), atol=1e-12)
        stamps = [p.header.stamp.sec + p.header.stamp.nanosec / 1e9 for p in poses]
        np.testing.assert_allclose(stamps, trajectory.stamps, atol=1e-6)
    assert [stamp for stamp, _ in messages["/objslam/pose"]] == np.round(trajectory.stamps * 1e9).astype(np.int64).tolist()


@pytest.mark.parametrize("start", [-1.0, 2.0**31])
def test_stamps_that_are_no_ros_time(result, start):
    from dataclasses import replace

    content = load_content(result)
    stamps = content.path.stamps - content.path.stamps[0] + start
    with pytest.raises(OutputError, match="no ROS time"):
        EXPORT.dump(replace(content, path=Trajectory(stamps, content.path.poses)))


def test_it_reads_back_as_a_recording(file):
    """`objslam info` finds the path in it."""
    from objslam.sources.ros_bag.info import describe

    info = describe(file)
    topics = {topic.name: topic for topic in info.topics}
    assert topics["/objslam/pose"].messages > 10
    assert info.damage == ()
