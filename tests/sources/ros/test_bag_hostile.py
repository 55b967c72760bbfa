"""Bags made to do harm, or made by chance: refused or bounded, with a clear line."""

import sqlite3
import struct
import zlib

import numpy as np
import pytest
import zstandard
from bag_writer import Raw, serialize, write_bag, write_mcap
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.ros.bag.recording import find_recording, read_messages
from objslam.sources import read
from objslam.sources.ros_bag.info import describe
from objslam.sources.ros_bag.log import read_bag
from objslam.sources.ros_bag.options import BagOptions

_S = 10**9
_MAGIC = b"\x89MCAP0\r\n"


def _odometry(maker, count=5):
    return [("/odom", t * _S, maker.odometry(t * _S, np.eye(4))) for t in range(1, count + 1)]


def _reports(path):
    reports = []
    count = sum(1 for _ in read_messages(find_recording(path, Ledger()), lambda connection: True, reports))
    return count, " ".join(line for report in reports for line in report.lines())


@pytest.mark.parametrize("name", ["../secret.db3", "/etc/passwd", "sub/../../secret.db3"])
def test_metadata_that_names_files_outside(tmp_path, makers, name):
    folder = write_bag(tmp_path / "drive", "sqlite3", makers["4"], _odometry(makers["4"]))
    (tmp_path / "secret.db3").write_bytes((folder / "drive.db3").read_bytes())
    text = (folder / "metadata.yaml").read_text().replace("drive.db3", name)
    (folder / "metadata.yaml").write_text(text)
    ledger = Ledger()
    recording = find_recording(folder, ledger)
    assert [file.path for file in recording.files] == [folder / "drive.db3"]
    assert ledger.dropped == {"bag file that metadata.yaml names outside of its folder": 1}


def test_a_link_that_leaves_the_folder(tmp_path, makers):
    folder = write_bag(tmp_path / "drive", "sqlite3", makers["4"], _odometry(makers["4"]))
    (folder / "drive.db3").rename(tmp_path / "outside.db3")
    (folder / "drive.db3").symlink_to(tmp_path / "outside.db3")
    ledger = Ledger()
    with pytest.raises(LogError):
        find_recording(folder, ledger)
    assert ledger.dropped["bag file that leaves the folder"] == 1


def test_frames_and_topics_that_look_like_paths_name_no_files(tmp_path, makers):
    maker, frame = makers["4"], "../../../tmp/evil\n"
    rows = _odometry(maker)
    rows.append(("/a", _S, maker.camera_info(_S, _camera(), frame)))
    rows.append(("/../../b", 2 * _S, maker.image(2 * _S, np.zeros((4, 6), np.uint8), "mono8", frame)))
    rows.append(("/tf_static", _S, maker.tf(_S, ("base_link", frame, np.eye(4)))))
    path = write_bag(tmp_path / "bag", "mcap-none", maker, rows)
    (camera_log,) = read_bag(path, Ledger(), BagOptions(extract=tmp_path / "out")).cameras
    assert camera_log.camera.name == "tmp_evil"
    assert all(p.resolve().is_relative_to((tmp_path / "out").resolve()) for p in camera_log.rgb.paths)


def _camera():
    from objslam.core.camera import Camera

    return Camera("c", 6, 4, np.array([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]))


def _detections(maker, count):
    """A message of many detections without a class, made of the bytes of one."""

    def of(number):
        message = maker.detections(_S, [(0, 0, 1, 1, 1, 0.5)] * number, "eye")
        for detection in message.detections:
            detection.results = []
        return serialize(maker, message)

    each = of(2)[len(of(1)) :]
    return Raw(of(0)[:-4] + struct.pack("<I", count) + each * count, "vision_msgs/msg/Detection2DArray")


@pytest.mark.parametrize("count", [9_000, 1_000_000])
def test_a_million_detections_in_one_message(tmp_path, makers, count):
    maker = makers["1"]  # no padding: a detection is the same bytes wherever it stands
    path = write_mcap(tmp_path / "x.mcap", "zstd", maker, [*_odometry(maker), ("/d", _S, _detections(maker, count))])
    info = describe(path)
    (topic,) = [topic for topic in info.topics if topic.name == "/d"]
    if count == 9_000:
        assert topic.detail == f"{count} boxes of 1 labels"
    else:
        assert topic.refused == ("1 more than 10000 detections in one message",)
    with pytest.raises(LogError, match=r"no camera|no CameraInfo"):
        read_bag(path, Ledger())


@pytest.mark.parametrize("kind", ["bag", "sqlite3"])
def test_too_many_detections_in_other_bags(tmp_path, makers, kind):
    maker = makers["1" if kind == "bag" else "4"]
    message = maker.detections(_S, [(0, 0, 1, 1, 1, 0.5)])
    message.detections = message.detections * 10_001
    info = describe(write_bag(tmp_path / "bag", kind, maker, [("/detections", _S, message)]))
    assert info.topics[0].refused == ("1 more than 10000 detections in one message",)


def _chunk(size, records, method=b"zstd", crc=0):
    body = struct.pack("<QQQI", 0, 0, size, crc) + struct.pack("<I", len(method)) + method + struct.pack("<Q", len(records))
    return struct.pack("<BQ", 6, len(body) + len(records)) + body + records


def test_sizes_without_sense_in_mcap(tmp_path, makers):
    good = write_mcap(tmp_path / "good.mcap", "zstd", makers["4"], _odometry(makers["4"])).read_bytes()
    bomb = zstandard.ZstdCompressor().compress(bytes(300 << 20))
    assert len(bomb) < 100_000
    evil = [
        _chunk(300 << 20, bomb),
        _chunk(10, bomb),
        _chunk(2**62, b""),
        _chunk(10, b"xx", b"\xff\xfe"),
        struct.pack("<BQ", 0xF0, 4) + b"abcd",
    ]
    evil.append(struct.pack("<BQ", 5, 3) + b"abc")
    evil.append(struct.pack("<BQ", 3, 20) + b"\x01\0\xff\xff\xff\x7f" + bytes(14))
    (tmp_path / "evil.mcap").write_bytes(good[:8] + b"".join(evil) + good[8:])
    count, lines = _reports(tmp_path / "evil.mcap")
    assert count == 5
    assert "would unpack to more than 256 MiB" in lines
    assert "its unpacked size is not the stated size" in lines
    assert "a broken schema, channel or message" in lines
    (tmp_path / "long.mcap").write_bytes(good[:8] + struct.pack("<BQ", 6, 2**60) + good[8:])
    count, lines = _reports(tmp_path / "long.mcap")
    assert count == 5
    assert "no records from byte 8" in lines


def test_sizes_without_sense_in_a_ros1_bag(tmp_path, makers):
    path = write_bag(tmp_path / "good", "bag-bz2", makers["1"], _odometry(makers["1"]))
    data = path.read_bytes()
    for at, value in (
        (data.index(b"index_pos=") + 10, b"\xff" * 8),
        (data.index(b"size=") + 5, b"\xff" * 4),
        (13, b"\xff" * 4),
    ):
        changed = bytearray(data)
        changed[at : at + len(value)] = value
        (tmp_path / "evil.bag").write_bytes(changed)
        count, lines = _reports(tmp_path / "evil.bag")
        assert count in (0, 5)
        assert lines


def test_a_view_that_makes_up_rows_without_end(tmp_path):
    database = sqlite3.connect(tmp_path / "evil.db3")
    database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
    database.execute(
        "CREATE VIEW messages AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) "
        "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM r"
    )
    database.commit()
    database.close()
    with pytest.raises(LogError, match="no tables of topics and messages"):
        describe(tmp_path / "evil.db3")


@pytest.mark.parametrize("column", ["topic_id", "timestamp", "data"])
def test_a_table_of_messages_without_a_column(tmp_path, makers, column):
    folder = write_bag(tmp_path / "drive", "sqlite3", makers["4"], _odometry(makers["4"]))
    with sqlite3.connect(folder / "drive.db3") as database:
        database.execute(f"ALTER TABLE messages RENAME COLUMN {column} TO other")
    database.close()
    for use in (describe, lambda path: read_bag(path, Ledger())):
        with pytest.raises(LogError, match="its table of messages lacks"):
            use(folder)


def test_rows_that_are_no_messages(tmp_path, makers):
    folder = write_bag(tmp_path / "drive", "sqlite3", makers["4"], _odometry(makers["4"]))
    database = sqlite3.connect(folder / "drive.db3")
    database.execute("INSERT INTO messages VALUES (100, 1, 'soon', x'0001')")
    database.execute("INSERT INTO messages VALUES (101, 1, 5, 'text')")
    database.execute("INSERT INTO messages VALUES (102, 77, 5, x'0001')")
    database.execute("INSERT INTO topics VALUES (9, x'ff', 3, 'cdr', '', '')")
    database.commit()
    database.close()
    count, lines = _reports(folder / "drive.db3")
    assert count == 5
    assert "rows that are not messages" in lines


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.sampled_from(["bag", "bag-lz4", "mcap-zstd", "mcap-none", "sqlite3"]), st.data())
def test_bytes_changed_at_random_never_end_in_a_traceback(tmp_path_factory, wholes, kind, data):
    content = bytearray(wholes[kind])
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(1, 4))] = data.draw(st.binary(min_size=1, max_size=4))
    path = tmp_path_factory.mktemp("fuzz") / f"x{ {'bag': '.bag', 'mcap': '.mcap'}.get(kind.split('-')[0], '.db3') }"
    path.write_bytes(content[: data.draw(st.integers(20, len(content)))])
    for look in (describe, lambda path: read(path, Ledger())):
        error = _error_of(look, path)
        assert error is None or "\n" not in str(error)


def _error_of(look, path):
    try:
        look(path)
    except LogError as error:
        return error
    return None


@pytest.fixture(scope="module")
def wholes(makers, tmp_path_factory):
    """Small bags with something of every kind, as bytes."""
    from drive_bag import rows_of, simulated

    log, folder = simulated(), tmp_path_factory.mktemp("wholes")
    found = {}
    for kind in ("bag", "bag-lz4", "mcap-zstd", "mcap-none", "sqlite3"):
        maker = makers["1" if kind.startswith("bag") else "4"]
        path = write_bag(folder / kind, kind, maker, rows_of(log, maker))
        found[kind] = (path / "sqlite3.db3" if kind == "sqlite3" else path).read_bytes()
    return found


def test_a_message_that_lies_about_its_length(tmp_path, makers):
    maker = makers["4"]
    data = bytearray(serialize(maker, maker.detections(_S, [(0, 0, 1, 1, "cup", 0.5)], "eye")))
    at = data.index(b"eye\0") + 4
    data[at : at + 4] = struct.pack("<I", 9000)
    records = struct.pack("<HIQQ", 1, 0, _S, _S) + bytes(data)
    good = write_mcap(tmp_path / "x.mcap", "none", maker, [("/d", _S, maker.detections(_S, [], "eye"))]).read_bytes()
    message = struct.pack("<BQ", 5, len(records)) + records
    start = good.index(struct.pack("<BQ", 6, 0)[:1], 8)
    (tmp_path / "x.mcap").write_bytes(good[:start] + _schema_and_channel(good) + message + good[start:])
    info = describe(tmp_path / "x.mcap")
    (topic,) = info.topics
    assert topic.messages == 2
    assert len(topic.refused) == 1
    assert "sequence length" in topic.refused[0]


def _schema_and_channel(data):
    """The schema and channel records of a file, out of its first chunk, which is not compressed."""
    start = data.index(struct.pack("<B", 3), 60)
    while True:
        op, size = struct.unpack_from("<BQ", data, start)
        if op == 3 and size < len(data):
            break
        start = data.index(b"\x03", start + 1)
    end = start + 9 + size
    op, size = struct.unpack_from("<BQ", data, end)
    assert op == 4
    assert zlib.crc32(data[start:end])
    return data[start : end + 9 + size]


_HEADER_TEXT = "std_msgs/Header header\n"
_OTHER_LAYOUTS = {
    "nav_msgs/msg/Odometry": _HEADER_TEXT + "string child_frame_id\n",
    "geometry_msgs/msg/PoseStamped": _HEADER_TEXT + "float64 pose\n",
    "geometry_msgs/msg/PoseWithCovarianceStamped": _HEADER_TEXT + "float64[7] pose\n",
    "tf2_msgs/msg/TFMessage": "std_msgs/Header[] transforms\n",
    "sensor_msgs/msg/CameraInfo": _HEADER_TEXT + "uint32 height\nuint32 width\nfloat64[4] k\n",
    "sensor_msgs/msg/Image": _HEADER_TEXT + "uint32 height\nuint32 width\n",
    "sensor_msgs/msg/CompressedImage": _HEADER_TEXT + "uint8 format\n",
    "vision_msgs/msg/Detection2DArray": _HEADER_TEXT + "string[] detections\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": _HEADER_TEXT + "int32 detections\n",
}
_OWN_HEADER = f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_OWN_TIME = f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"


@pytest.mark.parametrize("type_", _OTHER_LAYOUTS)
def test_a_known_name_with_other_fields(tmp_path, makers, type_):
    text = _OTHER_LAYOUTS[type_] + _OWN_HEADER + _OWN_TIME
    file = tmp_path / "drive.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(type_, "ros2msg", text.encode())
        channel = writer.register_channel("/tf" if "tf2" in type_ else "/topic", "cdr", schema)
        for t in range(3):
            data = struct.pack("<4sIII4s", b"\0\1\0\0", t + 1, 0, 4, b"map\0") + struct.pack("<I", 1) * 40
            writer.add_message(channel, t, data, t)
        writer.finish()
    info = describe(file, BagOptions())
    (topic,) = info.topics
    assert topic.messages == 3
    assert len(topic.refused) == 1
    with pytest.raises(LogError):
        read_bag(file, Ledger())
