"""Damaged bags give what a reader of bytes could still find, and say what is lost; the originals stay as they are."""

import contextlib
import hashlib
import io
import shutil
import sqlite3
import struct

import numpy as np
import pytest
import zstandard
from bag_writer import copy_cut, serialize, write_bag, write_mcap
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, breakup_chunk

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.ros.bag.recording import find_recording, read_messages
from objslam.sources.ros_bag.info import describe
from objslam.sources.ros_bag.log import read_bag
from objslam.sources.ros_bag.options import BagOptions

COUNT = 4000
_ENOUGH = 0.95


@pytest.fixture(scope="module")
def rows(makers):
    """Odometry along a line; every message differs from every other."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 0, 3] = np.arange(COUNT) * 0.01
    stamps = [10**18 + 20_000_000 * i for i in range(COUNT)]
    maker = makers["4"]
    return [("/odom", stamp, maker.odometry(stamp, pose)) for stamp, pose in zip(stamps, poses, strict=True)]


@pytest.fixture(scope="module")
def payloads(makers, rows):
    return [serialize(makers["4"], message) for _, _, message in rows]


@pytest.fixture(scope="module")
def bags(makers, rows, tmp_path_factory):
    """A whole bag of every storage."""
    folder = tmp_path_factory.mktemp("whole")
    kinds = ("mcap-none", "mcap-zstd", "mcap-lz4", "sqlite3")
    found = {kind: write_bag(folder / kind, kind, makers["4"], rows) for kind in kinds}
    found["sqlite3"] = found["sqlite3"] / "sqlite3.db3"
    old = [("/odom", stamp, makers["1"].odometry(stamp, _pose(message))) for _, stamp, message in rows]
    for kind in ("bag", "bag-bz2", "bag-lz4"):
        found[kind] = write_bag(folder / kind, kind, makers["1"], old)
    return found


def _pose(message):
    pose = np.eye(4)
    pose[0, 3] = message.pose.pose.position.x
    return pose


def _digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read(path):
    """The messages of a bag, and the reports; the file must be the same afterwards."""
    before = _digest(path)
    beside = sorted(path.parent.iterdir())
    reports = []
    messages = [data for _, _, data in read_messages(find_recording(path, Ledger()), lambda connection: True, reports)]
    assert _digest(path) == before
    assert sorted(path.parent.iterdir()) == beside
    return messages, reports


def _in_bytes(data, payloads):
    """Which payloads lie whole in some bytes, where they come in their order."""
    found, at = set(), 0
    for payload in payloads:
        place = data.find(payload, at, at + (1 << 20))
        if place >= 0:
            found.add(payload)
            at = place + len(payload)
    return found


def _recoverable(data, payloads):
    """What is left of an MCAP file, found chunk by chunk with the library's own classes, and in the stump of the last."""
    found = set()
    stream = StreamReader(io.BytesIO(data), emit_chunks=True)
    end = 8
    with contextlib.suppress(Exception):  # the library has no one kind of error for a file that ends
        for record in stream.records:
            end = stream._stream.count
            if isinstance(record, Chunk) and len(record.data) > 0:
                messages = [r.data for r in breakup_chunk(record, validate_crc=True) if hasattr(r, "publish_time")]
                found |= set(messages) & set(payloads)
    stump = data[end + 9 + 28 :]  # an opcode and a length, times, size and CRC: then what compresses
    start = stump.find(zstandard.FRAME_HEADER)
    if start >= 0:
        stump = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(stump[start:])).read(1 << 24)
    return found | _in_bytes(stump, payloads)


def test_whole_bags_have_nothing_to_report(bags, payloads):
    for kind, path in bags.items():
        messages, (report,) = _read(path)
        assert len(messages) == COUNT, kind
        assert not report.lines(), kind
        if not kind.startswith("bag"):
            assert messages == payloads


@pytest.mark.parametrize("kind", ["mcap-none", "mcap-zstd", "mcap-lz4"])
def test_mcap_without_footer(tmp_path, bags, payloads, kind):
    data = bags[kind].read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:-40])
    messages, (report,) = _read(path)
    assert messages == payloads
    assert report.lines() == [] or "cut off" in report.lines()[0]


@pytest.mark.parametrize("kind", ["mcap-none", "mcap-zstd", "mcap-lz4"])
@pytest.mark.parametrize("share", [0.11, 0.5, 0.9])
def test_mcap_with_half_a_chunk(tmp_path, bags, payloads, kind, share):
    path = copy_cut(bags[kind], tmp_path / "cut.mcap", share)
    messages, (report,) = _read(path)
    assert set(messages) <= set(payloads)
    possible = _recoverable(path.read_bytes(), payloads)
    assert len(possible) > 0.5 * share * COUNT
    assert len(set(messages) & possible) >= _ENOUGH * len(possible)
    assert "cut off" in report.lines()[0]
    assert "an unknown number lost" in report.lines()[0]


def test_an_mcap_that_was_never_closed_and_has_a_tail_of_zeros(tmp_path, makers, rows, payloads):
    path = write_mcap(tmp_path / "killed.mcap", "zstd", makers["4"], rows, finish=False)
    path.write_bytes(path.read_bytes() + bytes(100_000))
    messages, (report,) = _read(path)
    assert len(messages) > 0.9 * COUNT
    assert messages == payloads[: len(messages)]
    assert "never closed" in report.lines()[0]


def _chunks(data, kind):
    """Where the chunk records of an MCAP file begin: 37 bytes before the name of their compression."""
    name = {"mcap-none": b"\0\0\0\0", "mcap-zstd": b"\x04\0\0\0zstd", "mcap-lz4": b"\x03\0\0\0lz4"}[kind]
    size = 9 + 28 + len(name) + 8
    return [
        at
        for at in range(len(data) - size)
        if data[at] == 6
        and data.startswith(name, at + 37)
        and struct.unpack_from("<Q", data, at + 1)[0] == struct.unpack_from("<Q", data, at + size - 8)[0] + size - 9
    ]


@pytest.mark.parametrize("kind", ["mcap-none", "mcap-zstd", "mcap-lz4"])
def test_a_flipped_byte_costs_one_chunk_which_is_counted(tmp_path, bags, payloads, kind):
    data = bytearray(bags[kind].read_bytes())
    chunks = _chunks(data, kind)
    data[chunks[len(chunks) // 2] + 400] ^= 0x40
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    messages, (report,) = _read(path)
    assert set(messages) <= set(payloads)  # what is wrong is not taken for right
    assert len(messages) + report.lost == COUNT
    assert 0 < report.lost < 0.05 * COUNT
    assert "is broken" in report.lines()[0]
    ledger = Ledger()
    with pytest.raises(LogError, match=rf"no camera.*{report.lost} lost"):
        read_bag(path, ledger)
    assert ledger.dropped["message lost in a damaged bag"] == report.lost


def test_an_mcap_record_with_a_broken_length(tmp_path, bags, payloads):
    """Everything behind would be unreachable for who trusts the length: the next chunk is found by its looks."""
    data = bytearray(bags["mcap-zstd"].read_bytes())
    chunks = _chunks(data, "mcap-zstd")
    middle = chunks[len(chunks) // 2]
    data[middle + 6] ^= 0x80
    path = tmp_path / "broken.mcap"
    path.write_bytes(data)
    messages, (report,) = _read(path)
    assert set(messages) <= set(payloads)
    assert len(messages) + report.lost == COUNT
    assert report.lost < 0.05 * COUNT


@pytest.mark.parametrize("kind", ["bag", "bag-bz2", "bag-lz4"])
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_ros1_bags_that_are_cut(tmp_path, bags, kind, share):
    whole, _ = _read(bags[kind])
    path = copy_cut(bags[kind], tmp_path / "cut.bag", share)
    messages, (report,) = _read(path)
    assert messages == whole[: len(messages)]
    if kind == "bag":
        assert len(messages) >= _ENOUGH * len(_in_bytes(path.read_bytes(), whole))
    else:  # the share of the bytes is that of the messages, but for the index and a chunk
        assert len(messages) > (share - 0.04) * COUNT * 0.97
    assert "cut off" in report.lines()[0]


def test_a_ros1_bag_that_was_never_closed(tmp_path, bags):
    whole, _ = _read(bags["bag-lz4"])
    data = bytearray(bags["bag-lz4"].read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, at)
    data[at : at + 8] = bytes(8)
    path = tmp_path / "killed.bag.active"
    path.write_bytes(data[:index])
    messages, (report,) = _read(path)
    assert messages == whole
    assert "never closed" in report.lines()[0]


@pytest.mark.parametrize("kind", ["bag", "bag-bz2", "bag-lz4"])
def test_a_ros1_bag_with_a_hole(tmp_path, bags, kind):
    whole, _ = _read(bags[kind])
    data = bytearray(bags[kind].read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = b"\xaa" * 3000
    path = tmp_path / "hole.bag"
    path.write_bytes(data)
    messages, (report,) = _read(path)
    good = set(messages) & set(whole)
    assert len(messages) - len(good) <= 2  # ROS 1 has no CRC: a message whose middle is hit cannot be told
    assert len(messages) + report.lost == COUNT
    assert len(good) >= _ENOUGH * (COUNT if kind == "bag" else COUNT - 120)
    assert report.lines()


def _rows_in_pages(data):
    """Payloads of a database file found in its bytes alone: the cells of its table leaf pages, none of which overflows."""
    (page,) = struct.unpack_from(">H", data, 16)
    found = set()
    for start in range(0, len(data) - page + 1, page):
        leaf = data[start : start + page]
        if start and leaf[0] == 13:
            (cells,) = struct.unpack_from(">H", leaf, 3)
            for at in struct.unpack_from(f">{cells}H", leaf, 8):
                size, at = _varint(leaf, at)
                _, at = _varint(leaf, at)
                found.add(bytes(leaf[at : at + size]))
    return found


def _varint(data, at):
    value = 0
    while True:
        value = value << 7 | data[at] & 0x7F
        at += 1
        if data[at - 1] < 0x80:
            return value, at


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_sqlite_that_is_cut(tmp_path, bags, payloads, share):
    path = copy_cut(bags["sqlite3"], tmp_path / "cut.db3", share)
    messages, (report,) = _read(path)
    size = len(payloads[0])  # the last column of a row, and of one length in all of them
    possible = {cell[-size:] for cell in _rows_in_pages(path.read_bytes())} & set(payloads)
    assert len(possible) > 0.5 * share * COUNT
    assert set(messages) <= set(payloads)
    assert len(set(messages) & possible) >= _ENOUGH * len(possible)
    assert "pages are missing" in report.lines()[0]


@pytest.mark.parametrize("share", [0.35, 0.8])
def test_sqlite_that_is_cut_with_messages_over_many_pages(tmp_path, makers, share):
    """Images fill chains of overflow pages: all that lie before the cut come back to the byte, none of them half."""
    maker, count = makers["4"], 80
    noise = np.random.default_rng(0).integers(0, 256, (count, 100, 200)).astype(np.uint8)
    rows = [("/image", 10**9 * i, maker.image(10**9 * i, noise[i], "mono8")) for i in range(count)]
    expected = [serialize(maker, message) for _, _, message in rows]
    folder = write_bag(tmp_path / "x", "sqlite3", maker, rows)
    messages, (report,) = _read(copy_cut(folder / "x.db3", tmp_path / "cut.db3", share))
    assert messages == expected[: len(messages)]
    assert len(messages) >= int(share * count) - 3
    assert "pages are missing" in report.lines()[0]


def test_sqlite_with_a_broken_page(tmp_path, bags, payloads):
    data = bytearray(bags["sqlite3"].read_bytes())
    (page,) = struct.unpack_from(">H", data, 16)
    leaves = [at for at in range(page, len(data), page) if data[at] == 13 and payloads[COUNT // 2] in data[at : at + page]]
    data[leaves[0] : leaves[0] + page] = b"\xee" * page
    path = tmp_path / "broken.db3"
    path.write_bytes(data)
    messages, (report,) = _read(path)
    assert len(messages) + report.lost == COUNT
    assert 0 < report.lost < 10
    assert messages == [payload for payload in payloads if payload in set(messages)]
    assert "page" in report.lines()[0]


def test_a_leftover_wal_is_applied_to_a_copy(tmp_path, bags, payloads):
    path = tmp_path / "killed.db3"
    shutil.copyfile(bags["sqlite3"], path)
    half = sqlite3.connect(path)
    half.execute(f"DELETE FROM messages WHERE rowid > {COUNT // 4}")
    half.commit()
    half.execute("PRAGMA journal_mode = WAL")
    half.close()
    live = sqlite3.connect(path)
    live.execute("PRAGMA wal_autocheckpoint = 0")
    for row, payload in enumerate(payloads[COUNT // 4 :], start=COUNT // 4 + 1):
        live.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (row, row, payload))
    live.commit()
    killed = tmp_path / "copy"
    killed.mkdir()
    for name in ("killed.db3", "killed.db3-wal"):  # as they lie when the recorder is killed
        shutil.copyfile(tmp_path / name, killed / name)
    live.close()
    messages, (report,) = _read(killed / "killed.db3")
    assert messages == payloads
    assert "killed.db3-wal was applied to a copy" in report.lines()[0]
    (killed / "killed.db3-wal").unlink()
    assert len(_read(killed / "killed.db3")[0]) == COUNT // 4


def test_a_folder_tells_what_is_gone_by_its_metadata(tmp_path, makers, rows):
    folder = write_bag(tmp_path / "drive", "sqlite3", makers["4"], rows)
    copy_cut(folder / "drive.db3", folder / "drive.db3", 0.5)
    info = describe(folder)
    assert info.messages + info.lost == COUNT
    assert info.messages > 0.45 * COUNT
    cut, gone = info.damage
    assert "pages are missing" in cut
    assert gone.startswith("drive: ")
    assert gone.endswith(f"messages are missing, because metadata.yaml counts {COUNT}")
    (folder / "metadata.yaml").write_text("{")
    info = describe(folder)
    assert info.messages > 0.45 * COUNT
    assert any("metadata.yaml" in line and "left out" in line for line in info.warnings)


def test_a_file_that_is_no_bag_at_all_does_not_stop_the_others(tmp_path, bags):
    good, bad = tmp_path / "rec_0.mcap", tmp_path / "rec_1.db3"
    shutil.copyfile(bags["mcap-zstd"], good)
    bad.write_bytes(b"SQLite format 3\0" + bytes(1000))
    info = describe([good, bad], BagOptions())
    assert info.messages == COUNT
    assert any(str(bad) in line for line in info.damage)
