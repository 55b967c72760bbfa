"""Which files make a recording, and in which order."""

import shutil

import numpy as np
import pytest
import zstandard
from bag_writer import write_bag
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.ros.bag.recording import find_recording, is_bag, read_messages
from objslam.sources import read
from objslam.sources.ros_bag.info import describe

_S = 10**9


def _write(maker, path, kind, times):
    return write_bag(path, kind, maker, [("/odom", t * _S, maker.odometry(t * _S, np.eye(4))) for t in times])


def _stamps(recording):
    reports = []
    return [stamp // _S for _, stamp, _ in read_messages(recording, lambda connection: True, reports)]


@pytest.mark.parametrize("kind", ["bag", "bag-lz4", "mcap-zstd", "sqlite3"])
def test_the_same_messages_as_the_librarys_own_readers(makers, tmp_path, kind):
    """What is read record by record is what readers find that trust the indexes."""
    maker = makers["1" if kind.startswith("bag") else "4"]
    rows = [(f"/t{t % 3}", t * _S, maker.odometry(t * _S, np.eye(4))) for t in range(300)]
    path = write_bag(tmp_path / "x", kind, maker, rows)
    with (Reader1 if kind.startswith("bag") else Reader2)(path) as reader:
        expected = [(c.topic, c.msgtype, stamp, bytes(data)) for c, stamp, data in reader.messages()]
    found = read_messages(find_recording(path, Ledger()), lambda connection: True, [])
    assert [(c.topic, c.type, stamp, data) for c, stamp, data in found] == expected


@pytest.mark.parametrize("kind", ["bag", "mcap-zstd", "sqlite3"])
def test_only_the_wanted_topics(makers, tmp_path, kind):
    maker = makers["1" if kind == "bag" else "4"]
    rows = [(f"/t{t % 3}", t * _S, maker.odometry(t * _S, np.eye(4))) for t in range(30)]
    recording = find_recording(write_bag(tmp_path / "x", kind, maker, rows), Ledger())
    found = list(read_messages(recording, lambda connection: connection.topic == "/t1", []))
    assert [stamp // _S for _, stamp, _ in found] == list(range(1, 30, 3))


def test_files_of_one_recording_in_the_order_of_their_numbers(makers, tmp_path):
    for number in (10, 2, 0):
        _write(makers["1"], tmp_path / f"drive_{number}", "bag", (number, number + 1))
    ledger = Ledger()
    recording = find_recording(tmp_path, ledger)
    assert [file.path.name for file in recording.files] == ["drive_0.bag", "drive_2.bag", "drive_10.bag"]
    assert _stamps(recording) == [0, 1, 2, 3, 10, 11]
    files = [tmp_path / "drive_2.bag", tmp_path / "drive_0.bag"]
    assert _stamps(find_recording(files, ledger)) == [2, 3, 0, 1]
    assert find_recording(files, ledger).name == "drive"
    assert not ledger.lines()


def test_several_recordings_in_a_folder(makers, tmp_path):
    for name in ("monday", "tuesday"):
        _write(makers["4"], tmp_path / name, "mcap-none", (1,))
    with pytest.raises(LogError, match=r"several recordings: monday\.mcap, tuesday\.mcap.*name one of them"):
        find_recording(tmp_path, Ledger())


def test_a_recorder_that_was_killed_writes_no_metadata(makers, tmp_path):
    folder = _write(makers["4"], tmp_path / "drive", "sqlite3", range(5))
    (folder / "metadata.yaml").unlink()
    recording = find_recording(folder, Ledger())
    assert recording.expected is None
    assert _stamps(recording) == list(range(5))


def test_metadata_with_a_missing_file_and_an_extra_one(makers, tmp_path):
    folder = _write(makers["4"], tmp_path / "drive", "sqlite3", range(5))
    shutil.copyfile(folder / "drive.db3", folder / "stray.db3")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("- drive.db3", "- bag/drive.db3\n  - drive_1.db3"))
    ledger = Ledger()
    assert _stamps(find_recording(folder, ledger)) == list(range(5))
    assert ledger.dropped == {"bag file that metadata.yaml lists and that is missing": 1}
    assert "does not list stray.db3" in ledger.warnings[0]


def test_a_packed_file_without_metadata(makers, tmp_path):
    path = _write(makers["4"], tmp_path / "x", "mcap-none", range(5))
    packed = tmp_path / "packed.mcap.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(path.read_bytes()))
    assert is_bag(packed)
    assert _stamps(find_recording(packed, Ledger())) == list(range(5))
    packed.write_bytes(packed.read_bytes()[:-20])
    info = describe(packed)
    assert info.damage


@pytest.mark.parametrize("kind", ["bag", "mcap-none"])
def test_a_file_by_its_first_bytes(makers, tmp_path, kind):
    path = _write(makers["1" if kind == "bag" else "4"], tmp_path / "x", kind, range(3))
    path.rename(tmp_path / "recording.2026-01-01")
    assert is_bag(tmp_path / "recording.2026-01-01")
    assert _stamps(find_recording(tmp_path / "recording.2026-01-01", Ledger())) == [0, 1, 2]


def test_what_is_no_bag(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    assert not is_bag(tmp_path / "photo.jpg")
    assert not is_bag(tmp_path)
    assert not is_bag(tmp_path / "missing.bag")
    with pytest.raises(LogError, match="not a ROS bag"):
        find_recording([tmp_path / "photo.jpg"], Ledger())
    with pytest.raises(LogError, match="no bag file in it"):
        find_recording(tmp_path, Ledger())
    with pytest.raises(LogError, match="cannot be read"):
        find_recording(tmp_path / "missing.bag", Ledger())
    with pytest.raises(LogError, match="no bag is named"):
        find_recording([], Ledger())


def test_a_bag_is_a_source_like_any_other(makers, tmp_path):
    path = _write(makers["4"], tmp_path / "x", "mcap-none", range(3))
    with pytest.raises(LogError, match="no camera"):
        read(path, Ledger())
